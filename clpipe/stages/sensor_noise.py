"""Shot and read noise of the sensor."""

from collections.abc import Mapping
from dataclasses import replace
from typing import ClassVar

import numpy as np

from clpipe.reference.random import normal_at, square_root
from clpipe.stage import (
    Argument,
    Context,
    Frame,
    Kind,
    Method,
    Owner,
    Pass,
    Stage,
    parameter,
)
from clpipe.types import Floats


class Gaussian(Method):
    """Heteroscedastic Gaussian, Var[y] = a*y + b (Foi et al., IEEE TIP 2008, eq. 2).

    >>> from clpipe.stage import alone
    >>> noisy = alone(Gaussian(a=1e-3, b=1e-4), np.full((300, 300), 0.5, np.float32))
    >>> round(float(noisy.mean()), 2), round(float(noisy.var()), 4)
    (0.5, 0.0006)
    """

    method: ClassVar = "gaussian"
    kernel: ClassVar = "sensor_noise_gaussian"
    summary: ClassVar = "add Gaussian noise of variance a*y + b"

    a: float | None = parameter(
        None,
        "Shot noise: variance a unit of signal.",
        "signal",
        "from the camera and ISO",
        ge=0,
        le=1,
    )
    b: float | None = parameter(
        None,
        "Read noise: variance without light.",
        "signal^2",
        "from the camera and ISO",
        ge=0,
        le=1,
    )

    def resolve(self, context: Context) -> "Gaussian":
        if self.a is not None and self.b is not None:
            return self
        model = context.camera.noise(context.iso)
        return self.filled(a=model.a, b=model.b)

    def after(self, context: Context) -> Context:
        assert self.a is not None and self.b is not None
        return replace(context, noise=(self.a, self.b))

    def passes(self) -> tuple[Pass, ...]:
        return (Pass("sensor_noise", arguments=("a", "b"), random=Owner.IMAGE),)

    def arguments(self, context: Context) -> Mapping[str, Argument]:
        assert self.a is not None and self.b is not None
        return {"a": np.float32(self.a), "b": np.float32(self.b)}

    def reference(self, image: Floats, frame: Frame) -> Floats:
        assert self.a is not None and self.b is not None
        variance = np.maximum(np.float32(self.a) * image + np.float32(self.b), np.float32(0))
        return image + normal_at(image.shape, 0, frame.stream[Owner.IMAGE]) * square_root(variance)


STAGE = Stage("sensor_noise", "Add shot and read noise.", Kind.MOSAIC, Kind.MOSAIC, (Gaussian,))
