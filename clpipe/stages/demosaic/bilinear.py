"""Bilinear demosaicing."""

from typing import ClassVar

import numpy as np

from clpipe.base.types import Floats
from clpipe.reference.cfa import Pattern, by_site
from clpipe.stage import Method, Pass, ReferenceContext, Stencil
from clpipe.stages.demosaic.common import (
    HALF,
    QUARTER,
    mean_above_below,
    mean_left_right,
    red_and_blue,
    sum_of_corners,
)


def bilinear(image: Floats, pattern: Pattern) -> Floats:
    """Return RGB, (height, width, 3), from a (height, width) mosaic, by bilinear interpolation.

    A missing colour is the mean of its two or four nearest samples.

    >>> bilinear(np.float32([[4, 1], [3, 8]]), "RGGB")[0, 0].tolist()
    [4.0, 2.0, 8.0]
    """
    in_row, in_column = mean_left_right(image), mean_above_below(image)
    cross = (in_row + in_column) * HALF
    across = sum_of_corners(image) * QUARTER
    red, blue = red_and_blue(pattern, image, in_row, in_column, across)
    green = by_site(image.shape, pattern, cross, image, cross)
    return np.stack([red, green, blue], axis=-1)


class Bilinear(Method):
    """A missing colour is the mean of its nearest samples."""

    method: ClassVar = "bilinear"
    kernel: ClassVar = "demosaic_bilinear"
    summary: ClassVar = "mean of the nearest samples of each colour"

    def passes(self) -> tuple[Pass, ...]:
        return (Pass("bilinear", Stencil(1), ("pattern",)),)

    def reference(self, image: Floats, inputs: ReferenceContext) -> Floats:
        return bilinear(image, inputs.context.pattern)
