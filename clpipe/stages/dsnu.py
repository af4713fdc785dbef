"""Dark-signal non-uniformity; the part that columns share is column_noise."""

from typing import ClassVar

import numpy as np

from clpipe.base.types import Floats
from clpipe.reference.random import normal_at
from clpipe.stage import Context, Frame, GaussianNoise, Kind, NoiseScope, Pass, Stage


class Gaussian(GaussianNoise):
    """An offset of its own for each pixel, fixed for a camera (EMVA 1288, DSNU).

    In electrons it is the same at every ISO.

    >>> from clpipe.stage import run_reference
    >>> uneven = run_reference(Gaussian(sigma=0.01), np.zeros((300, 300), np.float32))
    >>> round(float(uneven.std()), 3)
    0.01
    """

    kernel: ClassVar = "dsnu"
    summary: ClassVar = "give each pixel of a camera an offset of its own"

    def resolve(self, context: Context) -> "Gaussian":
        camera = context.camera
        return self.filled(sigma=camera.signal_of(camera.dsnu, context.iso))

    def draw(self) -> tuple[Pass, ...]:
        return (Pass("dsnu", arguments=("sigma",), random=NoiseScope.CAMERA),)

    def reference(self, image: Floats, frame: Frame) -> Floats:
        normals = normal_at(image.shape, 0, frame.stream[NoiseScope.CAMERA])
        return image + normals * np.float32(self.sigma)


STAGE = Stage("dsnu", "Give pixels offsets of their own.", Kind.MOSAIC, Kind.MOSAIC, (Gaussian,))
