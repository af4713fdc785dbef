"""The mean filter."""

from typing import ClassVar

import numpy as np

from clpipe.base.types import Floats
from clpipe.reference.image import tap
from clpipe.stages.denoise.blended import BlendedFilter
from clpipe.stages.denoise.strength import size_parameter


class Mean(BlendedFilter):
    """Mean of a square window, blended with the image.

    It blurs edges as much as noise; it is a baseline to compare with.
    """

    method: ClassVar = "mean"
    kernel: ClassVar = "denoise_mean"
    summary: ClassVar = "mean of a window, blended in more strongly where there is more noise"
    tolerance: ClassVar = 2e-6  # sums come in another order
    function: ClassVar = "mean_filter"
    vectors_per_row: ClassVar = 1

    luma_size: int = size_parameter("luma", 3, 15)
    chroma_size: int = size_parameter("chroma", 3, 15)

    def window(self, image: Floats, reach: int) -> Floats:
        return box(image, reach)


def box(image: Floats, reach: int) -> Floats:
    """Mean of the (2*reach + 1)^2 pixels around each pixel.

    >>> box(np.float32([[1, 1, 4, 1]]), 1).tolist()
    [[1.0, 2.0, 2.0, 3.0]]
    """
    offsets = range(-reach, reach + 1)
    rows = sum((tap(image, 0, dy) for dy in offsets), np.zeros_like(image))
    total = sum((tap(rows, dx, 0) for dx in offsets), np.zeros_like(image))
    return total * np.float32(1 / len(offsets) ** 2)
