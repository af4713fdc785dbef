"""Dark-signal non-uniformity (DSNU); ``column_noise`` adds the part that columns share."""

from typing import ClassVar

from clpipe.stage import (
    Backend,
    Context,
    GaussianNoise,
    NoiseScope,
    Numbers,
    Pass,
    Signal,
    StageRole,
    sensor_normals,
    sensor_stage,
)


class Gaussian(GaussianNoise):
    """y + sigma * n: one Gaussian offset for each pixel, fixed for a camera (EMVA 1288, DSNU).

    n is a standard normal of the pixel; sigma is in signal units. The camera's sigma is the same at
    every ISO in electrons.

    >>> import numpy as np
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

    @classmethod
    def apply(cls, y: Signal, n: Numbers, backend: Backend) -> Signal:
        return y + backend.fixed(sensor_normals) * n["sigma"]


STAGE = sensor_stage(
    "dsnu", "Add a fixed offset to each pixel (DSNU).", (Gaussian,), role=StageRole.SENSOR_OFFSETS
)
