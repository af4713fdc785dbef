"""Row noise: offsets that all pixels of a row share, from the readout of that row."""

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
    """y + sigma * n_r: one Gaussian offset for each row, new in each image.

    n_r is a standard normal of row r; sigma is in signal units.

    >>> from clpipe.stage import run_reference
    >>> noisy = run_reference(Gaussian(sigma=0.01), np.zeros((1000, 2), np.float32))
    >>> round(float(noisy.std()), 3), bool((noisy[:, 0] == noisy[:, 1]).all())
    (0.01, True)
    """

    kernel: ClassVar = "line_noise"
    summary: ClassVar = "add a Gaussian offset to each row, new in each image"

    def resolve(self, context: Context) -> "Gaussian":
        return self.with_defaults(sigma=context.camera.row_noise(context.iso))

    def draw(self) -> tuple[Pass, ...]:
        return (
            Pass(
                "noise_of_lines",
                LineTable("rows"),
                arguments=("sigma",),
                writes="lines",
                random=NoiseScope.IMAGE,
            ),
            Pass("row_noise", arguments=("lines",)),
        )

    def reference(self, image: Floats, given: ReferenceContext) -> Floats:
        normals = normal_of_line(image.shape[0], given.stream[NoiseScope.IMAGE])
        return image + (normals * np.float32(self.sigma))[:, None]


STAGE = Stage("row_noise", "Add an offset to each row.", Kind.MOSAIC, Kind.MOSAIC, (Gaussian,))
