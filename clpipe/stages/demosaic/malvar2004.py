"""Malvar, He and Cutler's linear demosaicing."""

from typing import ClassVar

import numpy as np

from clpipe.base.types import Floats
from clpipe.reference.cfa import Pattern, by_site
from clpipe.reference.image import tap
from clpipe.stage import Method, Pass, ReferenceContext, Stencil
from clpipe.stages.demosaic.common import EIGHTH, HALF, red_and_blue, sum_of_corners

TWO, FOUR, FIVE, SIX = np.float32(2), np.float32(4), np.float32(5), np.float32(6)


def malvar2004(image: Floats, pattern: Pattern) -> Floats:
    """Return RGB, (height, width, 3), from a mosaic, with linear 5x5 filters.

    H. S. Malvar, L. He, R. Cutler: "High-quality linear interpolation for demosaicing of
    Bayer-patterned color images", ICASSP 2004, figure 2. Each filter is the bilinear one plus the
    Laplacian of the site's own colour times a gain. The gain is 1/2 for green, 5/8 for red and blue
    at green sites, and 3/4 for red at blue sites and blue at red sites.

    >>> grey_ramp = np.arange(49, dtype=np.float32).reshape(7, 7)
    >>> malvar2004(grey_ramp, "GRBG")[3, 3].tolist()
    [24.0, 24.0, 24.0]
    """
    near_x, near_y = tap(image, -1, 0) + tap(image, 1, 0), tap(image, 0, -1) + tap(image, 0, 1)
    far_x, far_y = tap(image, -2, 0) + tap(image, 2, 0), tap(image, 0, -2) + tap(image, 0, 2)
    corners, far = sum_of_corners(image), far_x + far_y
    green = ((near_x + near_y) * TWO + image * FOUR - far) * EIGHTH
    at_green = image * FIVE - corners
    in_row = (at_green + near_x * FOUR - far_x + far_y * HALF) * EIGHTH
    in_column = (at_green + near_y * FOUR - far_y + far_x * HALF) * EIGHTH
    across = (image * SIX + corners * TWO - far * np.float32(1.5)) * EIGHTH
    red, blue = red_and_blue(pattern, image, in_row, in_column, across)
    return np.stack([red, by_site(image.shape, pattern, green, image, green), blue], axis=-1)


class Malvar2004(Method):
    """Linear 5x5 filters (Malvar, He and Cutler, ICASSP 2004)."""

    method: ClassVar = "malvar2004"
    kernel: ClassVar = "demosaic_malvar2004"
    summary: ClassVar = "linear 5x5 filters with gradient correction (Malvar, He, Cutler)"

    def passes(self) -> tuple[Pass, ...]:
        return (Pass("malvar2004", Stencil(2), ("pattern",)),)

    def reference(self, image: Floats, inputs: ReferenceContext) -> Floats:
        return malvar2004(image, inputs.context.pattern)
