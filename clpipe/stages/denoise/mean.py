"""The mean of a window."""

from typing import ClassVar

import numpy as np

from clpipe.base.types import Floats
from clpipe.reference.image import tap
from clpipe.stages.denoise.blended import BlendedFilter
from clpipe.stages.denoise.strength import size_of


class Mean(BlendedFilter):
    """Mean of a square window. It does not know an edge from noise; it is here to compare with."""

    method: ClassVar = "mean"
    kernel: ClassVar = "denoise_mean"
    summary: ClassVar = "mean of a window, more of it the more noise there is"
    tolerance: ClassVar = 2e-6  # sums come in another order
    function: ClassVar = "mean_filter"
    block: ClassVar = 1

    luma_size: int = size_of("luma", 3, 15)
    chroma_size: int = size_of("chroma", 3, 15)

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
