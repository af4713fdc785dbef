"""Mean and median: filters that ignore the noise, blended with the image according to it."""

from typing import ClassVar

import numpy as np

from clpipe.base.types import Floats
from clpipe.reference.colour import rgb_to_ycbcr, ycbcr_to_rgb
from clpipe.reference.image import tap
from clpipe.reference.median import median_filter
from clpipe.stage import Arguments, Context, ReferenceContext
from clpipe.stages.denoise.strength import WindowDenoiser, size_parameter

# Signal units; the assumed standard deviation of detail relative to its neighbours. We chose this
# value. tools/pages/quality.py measures its PSNR, and no test asserts that it is optimal.
DETAIL = 0.02


def blend_share(amount: float) -> float:
    """Return the share of the filtered image in the result: s^2 / (s^2 + t^2).

    Wiener's shrinkage (Lee, IEEE PAMI 1980) with the same standard deviation of detail, t = 0.02,
    for all images. s is ``amount``, strength * noise. Both are in signal units.

    >>> [round(float(blend_share(s)), 2) for s in (0, 0.002, 0.01, 0.05)]
    [0.0, 0.01, 0.2, 0.86]
    """
    return amount**2 / (amount**2 + DETAIL**2)


class BlendedFilter(WindowDenoiser):
    """centre + share * (filtered - centre); the share grows with the noise, :func:`blend_share`."""

    names: ClassVar = ("luma_share", "chroma_share")

    def window(self, image: Floats, reach: int) -> Floats:
        """Filter windows 2*reach + 1 px wide; (height, width, plane) in and out."""
        raise NotImplementedError(type(self).__name__)

    @property
    def effect(self) -> str:
        luma, chroma = (f"{blend_share(amount):.0%}" for amount in self.amounts)
        formula = f"share = s^2 / (s^2 + {DETAIL:g}^2), s = strength * noise"
        return f"{formula}: luma {luma}, chroma {chroma}"

    def arguments(self, context: Context) -> Arguments:
        luma, chroma = self.amounts
        return {
            **super().arguments(context),
            "luma_share": blend_share(luma),
            "chroma_share": blend_share(chroma),
        }

    def reference(self, image: Floats, inputs: ReferenceContext) -> Floats:
        planes = rgb_to_ycbcr(image)
        luma, chroma = (np.float32(blend_share(amount)) for amount in self.amounts)
        y, c = planes[..., :1], planes[..., 1:]
        y = y + luma * (self.window(y, self.reaches[0]) - y)
        c = c + chroma * (self.window(c, self.reaches[1]) - c)
        return ycbcr_to_rgb(np.concatenate([y, c], axis=-1))


class Mean(BlendedFilter):
    """Mean of a square window, blended with the image.

    It blurs edges as much as noise, and serves as a baseline.
    """

    method: ClassVar = "mean"
    kernel: ClassVar = "denoise_mean"
    summary: ClassVar = "mean of a window, mixed in more strongly if there is more noise"
    tolerance: ClassVar = 2e-6  # the kernel adds in another order
    function: ClassVar = "mean_filter"
    vectors_per_row: ClassVar = 1

    luma_size: int = size_parameter("luma", 3, 15)
    chroma_size: int = size_parameter("chroma", 3, 15)

    def window(self, image: Floats, reach: int) -> Floats:
        return box(image, reach)


def box(image: Floats, reach: int) -> Floats:
    """Return the mean of the (2*reach + 1)^2 pixels around each pixel.

    >>> box(np.float32([[1, 1, 4, 1]]), 1).tolist()
    [[1.0, 2.0, 2.0, 3.0]]
    """
    offsets = range(-reach, reach + 1)
    rows = sum((tap(image, 0, dy) for dy in offsets), np.zeros_like(image))
    total = sum((tap(rows, dx, 0) for dx in offsets), np.zeros_like(image))
    return total * np.float32(1 / len(offsets) ** 2)


class Median(BlendedFilter):
    """Median of a square window (Tukey, Exploratory Data Analysis, 1977), blended with the image.

    Each plane is filtered separately.
    """

    method: ClassVar = "median"
    kernel: ClassVar = "denoise_median"
    summary: ClassVar = "median of a window, mixed in more strongly if there is more noise"
    tolerance: ClassVar = 1e-6  # conversion to luma and chroma is not exact
    function: ClassVar = "median_filter"
    largest_size: ClassVar = 5

    luma_size: int = size_parameter("luma", 3, 5)
    chroma_size: int = size_parameter("chroma", 3, 5)

    def window(self, image: Floats, reach: int) -> Floats:
        return median_filter(image, 2 * reach + 1)
