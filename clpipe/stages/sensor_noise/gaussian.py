"""Sensor noise as one heteroscedastic Gaussian."""

from typing import Any, ClassVar

import numpy as np

from clpipe.base.types import Floats
from clpipe.stage import Arguments, Backend, Context, NoiseScope, Numbers, Pass, Signal
from clpipe.stages.sensor_noise.model import SensorNoise, unit_read_noise
from clpipe.stages.sensor_noise.no_noise import NEVER_FULL, or_default


class Gaussian(SensorNoise):
    """Heteroscedastic Gaussian noise, Var[y] = a*y + b (Foi et al., IEEE TIP 2008, eq. 2).

    The noisy signal is limited to the full well. With ``tukey_lambda``, the read noise, of variance
    b, is drawn from a Tukey lambda distribution instead and added after this limit.

    >>> from clpipe.stage import run_reference
    >>> noisy = run_reference(Gaussian(a=1e-3, b=1e-4), np.full((300, 300), 0.5, np.float32))
    >>> round(float(noisy.mean()), 2), round(float(noisy.var()), 4)
    (0.5, 0.0006)
    """

    method: ClassVar = "gaussian"
    kernel: ClassVar = "sensor_noise_gaussian"
    summary: ClassVar = "add Gaussian noise of variance a*y + b"
    other_examples: ClassVar = ({"tukey_lambda": -0.2, "full_well": 1000.0},)
    functions: ClassVar = ("sensor_noise", "sensor_noise_tukey")  # names in the kernel file

    def passes(self) -> tuple[Pass, ...]:
        of_gaussian, of_tukey = self.functions
        if self.tukey_lambda is None:
            names: tuple[str, ...] = ("a", "b", "full_well")
            return (Pass(of_gaussian, arguments=names, random=NoiseScope.IMAGE),)
        names = ("a", "full_well", "read_noise", "shape", "scale")
        return (Pass(of_tukey, arguments=names, random=NoiseScope.IMAGE),)

    def variance(self, input_variance: Floats, signal: Floats, context: Context) -> Floats | None:
        # In this model, a negative signal lowers the variance below b.
        if self.tukey_lambda is None:
            return np.maximum(self.added_variance(signal), np.float32(0)) + input_variance
        return super().variance(input_variance, signal, context)

    def arguments(self, context: Context) -> Arguments:
        full = or_default(self.full_signal, NEVER_FULL)
        numbers = {"a": self.a, "full_well": full}
        if self.tukey_lambda is None:
            return {**numbers, "b": self.b}
        return {**numbers, **self.read_noise_numbers()}

    @classmethod
    def apply(cls, y: Signal, n: Numbers, backend: Backend) -> Signal:
        noise = cls.noise(backend.normals(), y, n["a"], n.get("b", 0.0), backend)
        noisy = backend.minimum(y + noise, n["full_well"])
        return noisy if "b" in n else noisy + unit_read_noise(n, backend) * n["read_noise"]

    @staticmethod
    def noise(normals: Signal, y: Signal, a: Any, b: Any, backend: Backend) -> Signal:
        """Return the noise of a signal y from standard normals."""
        return normals * backend.square_root((a * y + b).clip(min=0))
