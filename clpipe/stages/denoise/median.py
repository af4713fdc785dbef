"""The median filter."""

from typing import ClassVar

from clpipe.base.types import Floats
from clpipe.reference.median import median_filter
from clpipe.stages.denoise.blended import BlendedFilter
from clpipe.stages.denoise.strength import size_parameter


class Median(BlendedFilter):
    """Median of a square window (Tukey, Exploratory Data Analysis, 1977), blended with the image.

    Each plane is filtered by itself.
    """

    method: ClassVar = "median"
    kernel: ClassVar = "denoise_median"
    summary: ClassVar = "median of a window, blended in more strongly where there is more noise"
    tolerance: ClassVar = 1e-6  # luma and chroma are not exact
    function: ClassVar = "median_filter"
    largest_size: ClassVar = 5

    luma_size: int = size_parameter("luma", 3, 5)
    chroma_size: int = size_parameter("chroma", 3, 5)

    def window(self, image: Floats, reach: int) -> Floats:
        return median_filter(image, 2 * reach + 1)
