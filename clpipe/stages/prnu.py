"""Photo-response non-uniformity."""

from typing import ClassVar

import numpy as np

from clpipe.base.types import Floats
from clpipe.reference.random import normal_at
from clpipe.stage import Context, Frame, GaussianNoise, Kind, NoiseScope, Pass, Stage, parameter


class Gaussian(GaussianNoise):
    """A sensitivity of its own for each pixel, fixed for a camera (EMVA 1288, PRNU).

    >>> from clpipe.stage import run_reference
    >>> uneven = run_reference(Gaussian(sigma=0.01), np.full((300, 300), 0.5, np.float32))
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
        return (Pass("prnu", arguments=("sigma",), random=NoiseScope.CAMERA),)

    def variance(self, before: Floats, signal: Floats, context: Context) -> Floats:
        return (signal * signal + before) * np.float32(self.sigma) ** 2 + before

    def reference(self, image: Floats, frame: Frame) -> Floats:
        normals = normal_at(image.shape, 0, frame.stream[NoiseScope.CAMERA])
        return image * (normals * np.float32(self.sigma) + np.float32(1))


STAGE = Stage("prnu", "Make pixels unequally sensitive.", Kind.MOSAIC, Kind.MOSAIC, (Gaussian,))
