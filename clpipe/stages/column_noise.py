"""Column noise: offsets that all pixels of a column share, from that column's readout circuit."""

from typing import ClassVar

import numpy as np

from clpipe.base.types import Floats
from clpipe.reference.random import normal_of_line
from clpipe.stage import (
    Context,
    GaussianNoise,
    Kind,
    LineTable,
    NoiseScope,
    Pass,
    ReferenceContext,
    Stage,
)


class Gaussian(GaussianNoise):
    """y + sigma * n_x: one Gaussian offset for each column, the same in every image of a camera.

    n_x is a standard normal of column x; sigma is in signal units.

    >>> from clpipe.stage import run_reference
    >>> noisy = run_reference(Gaussian(sigma=0.01), np.zeros((2, 1000), np.float32))
    >>> round(float(noisy.std()), 3), bool((noisy[0] == noisy[1]).all())
    (0.01, True)
    """

    kernel: ClassVar = "line_noise"
    summary: ClassVar = "add a Gaussian offset to each column, the same in every image of a camera"

    def resolve(self, context: Context) -> "Gaussian":
        return self.with_defaults(sigma=context.camera.column_noise(context.iso))

    def draw(self) -> tuple[Pass, ...]:
        return (
            Pass(
                "noise_of_lines",
                LineTable("columns"),
                arguments=("sigma",),
                writes="lines",
                random=NoiseScope.CAMERA,
            ),
            Pass("column_noise", arguments=("lines",)),
        )

    def reference(self, image: Floats, given: ReferenceContext) -> Floats:
        normals = normal_of_line(image.shape[1], given.stream[NoiseScope.CAMERA])
        return image + (normals * np.float32(self.sigma))[None, :]


STAGE = Stage(
    "column_noise", "Add an offset to each column.", Kind.MOSAIC, Kind.MOSAIC, (Gaussian,)
)
