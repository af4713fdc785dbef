"""Photo-response non-uniformity (PRNU): pixels differ in sensitivity."""

from typing import ClassVar

import numpy as np

from clpipe.base.types import Floats
from clpipe.stage import (
    Backend,
    Context,
    GaussianNoise,
    NoiseScope,
    Numbers,
    Pass,
    Signal,
    camera_parameter,
    sensor_normals,
    sensor_stage,
)


class Gaussian(GaussianNoise):
    """y * (1 + sigma * n): one sensitivity for each pixel, fixed for a camera (EMVA 1288, PRNU).

    n is a standard normal of the pixel; sigma is relative to the mean sensitivity.

    >>> from clpipe.stage import run_reference
    >>> uneven = run_reference(Gaussian(sigma=0.01), np.full((300, 300), 0.5, np.float32))
    >>> round(float(uneven.std()), 4)
    0.005
    """

    kernel: ClassVar = "prnu"
    summary: ClassVar = "multiply each pixel by a sensitivity, the same in every image of a camera"

    sigma: float | None = camera_parameter(
        "Standard deviation of the sensitivities; their mean is 1.", ge=0, le=0.5
    )

    def resolve(self, context: Context) -> "Gaussian":
        return self.with_defaults(sigma=context.camera.prnu)

    def draw(self) -> tuple[Pass, ...]:
        return (Pass("prnu", arguments=("sigma",), random=NoiseScope.CAMERA),)

    def variance(self, input_variance: Floats, signal: Floats, context: Context) -> Floats:
        """(1 + sigma^2) * input_variance + sigma^2 * signal^2, exact for independent noise."""
        return (signal * signal + input_variance) * np.float32(self.sigma) ** 2 + input_variance

    @classmethod
    def apply(cls, y: Signal, n: Numbers, backend: Backend) -> Signal:
        return y * (backend.fixed(sensor_normals) * n["sigma"] + 1)


STAGE = sensor_stage("prnu", "Vary the sensitivity of pixels (PRNU).", (Gaussian,))
