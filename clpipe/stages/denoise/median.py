"""The median of a window."""

from typing import ClassVar

import numpy as np

from clpipe.reference.image import tap
from clpipe.stages.denoise.law import size_of
from clpipe.stages.denoise.share import Shared
from clpipe.types import Floats


class Median(Shared):
    """Median of a square window (Tukey, Exploratory Data Analysis, 1977), each plane by itself."""

    method: ClassVar = "median"
    kernel: ClassVar = "denoise_median"
    summary: ClassVar = "median of a window, more of it the more noise there is"
    tolerance: ClassVar = 1e-6  # luma and chroma are not exact
    function: ClassVar = "median_filter"
    largest_size: ClassVar = 5

    luma_size: int = size_of("luma", 3, 5)
    chroma_size: int = size_of("chroma", 3, 5)

    def window(self, image: Floats, reach: int) -> Floats:
        return median(image, reach)


def median(image: Floats, reach: int) -> Floats:
    """Median of the (2*reach + 1)^2 pixels around each pixel.

    >>> median(np.float32([[1, 9, 2, 3]]), 1).tolist()
    [[9.0, 2.0, 3.0, 2.0]]
    """
    offsets = range(-reach, reach + 1)
    around = np.stack([tap(image, dx, dy) for dy in offsets for dx in offsets])
    return np.median(around, axis=0).astype(np.float32)
