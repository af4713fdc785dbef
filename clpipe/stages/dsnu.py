"""Dark-signal non-uniformity (DSNU); the part that a column shares is ``column_noise``."""

from typing import ClassVar

import numpy as np

from clpipe.base.types import Floats
from clpipe.reference.random import normal_at
from clpipe.stage import Context, GaussianNoise, Kind, NoiseScope, Pass, ReferenceContext, Stage


class Gaussian(GaussianNoise):
    """y + sigma * n: one Gaussian offset for each pixel, fixed for a camera (EMVA 1288, DSNU).

    n is a standard normal of the pixel; sigma is in signal units. In electrons, the camera's sigma
    is the same at every ISO.

    >>> from clpipe.stage import run_reference
    >>> uneven = run_reference(Gaussian(sigma=0.01), np.zeros((300, 300), np.float32))
    >>> round(float(uneven.std()), 3)
    0.01
    """

    kernel: ClassVar = "dsnu"
    summary: ClassVar = "add a Gaussian offset to each pixel, the same in every image of a camera"

    def resolve(self, context: Context) -> "Gaussian":
        camera = context.camera
        return self.with_defaults(sigma=camera.signal_of(camera.dsnu, context.iso))

    def draw(self) -> tuple[Pass, ...]:
        return (Pass("dsnu", arguments=("sigma",), random=NoiseScope.CAMERA),)

    def reference(self, image: Floats, given: ReferenceContext) -> Floats:
        normals = normal_at(image.shape, 0, given.stream[NoiseScope.CAMERA])
        return image + normals * np.float32(self.sigma)


STAGE = Stage("dsnu", "Add a fixed offset to each pixel.", Kind.MOSAIC, Kind.MOSAIC, (Gaussian,))
