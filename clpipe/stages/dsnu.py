"""Dark-signal non-uniformity; the part that columns share is column_noise."""

from collections.abc import Mapping
from typing import ClassVar

import numpy as np

from clpipe.reference.random import normal_at
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
    """An offset of its own for each pixel, fixed for a camera (EMVA 1288, DSNU).

    In electrons it is the same at every ISO.

    >>> from clpipe.stage import alone
    >>> uneven = alone(Gaussian(sigma=0.01), np.zeros((300, 300), np.float32))
    >>> round(float(uneven.std()), 3)
    0.01
    """

    method: ClassVar = "gaussian"
    kernel: ClassVar = "dsnu"
    summary: ClassVar = "give each pixel of a camera an offset of its own"
    example: ClassVar = {"sigma": 0.01}

    sigma: float | None = parameter(
        None,
        "Standard deviation of the offsets.",
        "signal",
        "from the camera and ISO",
        ge=0,
        le=1,
    )

    def resolve(self, context: Context) -> "Gaussian":
        camera = context.camera
        return self.filled(sigma=camera.signal_of(camera.dsnu, context.iso))

    def passes(self) -> tuple[Pass, ...]:
        return (Pass("dsnu", arguments=("sigma",), random=Owner.CAMERA),) if self.sigma else ()

    def arguments(self, context: Context) -> Mapping[str, Argument]:
        return {"sigma": np.float32(self.sigma)}

    def reference(self, image: Floats, frame: Frame) -> Floats:
        return image + normal_at(image.shape, 0, frame.stream[Owner.CAMERA]) * np.float32(
            self.sigma
        )


STAGE = Stage("dsnu", "Give pixels offsets of their own.", Kind.MOSAIC, Kind.MOSAIC, (Gaussian,))
