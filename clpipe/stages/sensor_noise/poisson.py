"""Sensor noise as whole photo-electrons and read noise."""

from typing import ClassVar, Self

from clpipe.base.errors import RequestError
from clpipe.stage import Arguments, Backend, Context, NoiseScope, Numbers, Pass, Signal
from clpipe.stages.sensor_noise.model import SensorNoise, unit_read_noise
from clpipe.stages.sensor_noise.no_noise import NEVER_FULL


class Poisson(SensorNoise):
    """Whole photo-electrons: a * min(Poisson(max(y, 0) / a), full well) + read noise (EMVA 1288).

    Poisson numbers come from the inverse CDF (Giles, ACM TOMS 42(1), 2016). The read noise has the
    variance b and a Gaussian or, with ``tukey_lambda``, a Tukey lambda distribution.

    >>> import numpy as np
    >>> from clpipe.stage import run_reference
    >>> noisy = run_reference(Poisson(a=1e-3, b=1e-4), np.full((300, 300), 0.5, np.float32))
    >>> round(float(noisy.mean()), 2), round(float(noisy.var()), 4)
    (0.5, 0.0006)
    """

    method: ClassVar = "poisson"
    kernel: ClassVar = "sensor_noise_poisson"
    summary: ClassVar = "draw whole photo-electrons and add read noise"
    other_examples: ClassVar = (
        {"a": 0.05, "b": 1e-4},
        {"tukey_lambda": -0.2, "full_well": 1000.0},
    )

    def resolve(self, context: Context) -> Self:
        resolved = super().resolve(context)
        if not resolved.a:
            raise RequestError(
                "sensor_noise: the method poisson needs the parameter a above 0; for noise "
                "without shot noise, use the method gaussian"
            )
        return resolved

    def passes(self) -> tuple[Pass, ...]:
        gaussian = self.tukey_lambda is None
        names = ("chi", "full_well", "a", "read_noise")
        return (
            Pass(
                "sensor_noise_poisson" if gaussian else "sensor_noise_poisson_tukey",
                arguments=names if gaussian else (*names, "shape", "scale"),
                random=NoiseScope.IMAGE,
            ),
        )

    def arguments(self, context: Context) -> Arguments:
        assert self.a
        return {
            "chi": 1 / self.a,
            "full_well": self.full_well or NEVER_FULL,
            "a": self.a,
            **self.read_noise_numbers(),
        }

    @classmethod
    def apply(cls, y: Signal, n: Numbers, backend: Backend) -> Signal:
        electrons = backend.photons(y.clip(min=0) * n["chi"], backend.words())
        counted = backend.minimum(electrons, n["full_well"])
        return counted * n["a"] + unit_read_noise(n, backend) * n["read_noise"]
