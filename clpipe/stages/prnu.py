"""Photo-response non-uniformity."""

from typing import ClassVar

import numpy as np

from clpipe.reference.random import normal_at
from clpipe.stage import Context, Frame, GaussianNoise, Kind, Owner, Pass, Stage, parameter
from clpipe.types import Floats


class Gaussian(GaussianNoise):
    """A sensitivity of its own for each pixel, fixed for a camera (EMVA 1288, PRNU).

    >>> from clpipe.stage import alone
    >>> uneven = alone(Gaussian(sigma=0.01), np.full((300, 300), 0.5, np.float32))
    >>> round(float(uneven.std()), 4)
    0.005
    """

    kernel: ClassVar = "prnu"
    summary: ClassVar = "give each pixel of a camera a sensitivity of its own"

    sigma: float | None = parameter(
        None,
        "Standard deviation of the sensitivities; their mean is 1.",
        "",
        "from the camera",
        ge=0,
        le=0.5,
    )

    def resolve(self, context: Context) -> "Gaussian":
        return self.filled(sigma=context.camera.prnu)

    def draw(self) -> tuple[Pass, ...]:
        return (Pass("prnu", arguments=("sigma",), random=Owner.CAMERA),)

    def variance(self, before: Floats, signal: Floats, context: Context) -> Floats:
        return (signal * signal + before) * np.float32(self.sigma) ** 2 + before

    def reference(self, image: Floats, frame: Frame) -> Floats:
        normals = normal_at(image.shape, 0, frame.stream[Owner.CAMERA])
        return image * (normals * np.float32(self.sigma) + np.float32(1))


STAGE = Stage("prnu", "Make pixels unequally sensitive.", Kind.MOSAIC, Kind.MOSAIC, (Gaussian,))
