"""The median of a window."""

from typing import ClassVar

from clpipe.base.types import Floats
from clpipe.reference.median import median_filter
from clpipe.stages.denoise.blended import BlendedFilter
from clpipe.stages.denoise.strength import size_of


class Median(BlendedFilter):
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
        return median_filter(image, 2 * reach + 1)
