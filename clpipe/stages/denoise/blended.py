"""The base of mean and median: filters that ignore the noise, blended with the image by it."""

from collections.abc import Mapping
from typing import ClassVar

import numpy as np

from clpipe.base.tracing import float32
from clpipe.base.types import Floats
from clpipe.reference.colour import rgb_to_ycbcr, ycbcr_to_rgb
from clpipe.stage import Context, ReferenceContext
from clpipe.stages.denoise.strength import WindowDenoiser

# Assumed standard deviation of detail against its neighbours, signal units. Chosen, not derived;
# tools/pages/quality.py measures the PSNR that it gives, and no test holds it to be the best.
DETAIL = 0.02


def blend_share(amount: float) -> np.float32:
    """The share of the filtered image in the result: s^2 / (s^2 + t^2).

    Wiener's shrinkage (Lee, IEEE PAMI 1980) with one standard deviation of detail, t = 0.02, for
    all pictures; s is ``amount``, strength * noise, both in signal units.

    >>> [round(float(blend_share(s)), 2) for s in (0, 0.002, 0.01, 0.05)]
    [0.0, 0.01, 0.2, 0.86]
    """
    return float32(amount**2 / (amount**2 + DETAIL**2))


class BlendedFilter(WindowDenoiser):
    """centre + share * (filtered - centre); the share grows with the noise, :func:`blend_share`."""

    names: ClassVar = ("luma_share", "chroma_share")

    def window(self, image: Floats, reach: int) -> Floats:
        """The filter over windows 2*reach + 1 px wide; (height, width, plane) in and out."""
        raise NotImplementedError(type(self).__name__)

    @property
    def effect(self) -> str:
        luma, chroma = (f"{blend_share(amount):.0%}" for amount in self.amounts)
        formula = f"share = s^2 / (s^2 + {DETAIL:g}^2), s = strength * noise"
        return f"{formula}: luma {luma}, chroma {chroma}"

    def numbers(self, context: Context) -> Mapping[str, np.float32]:
        luma, chroma = self.amounts
        return {"luma_share": blend_share(luma), "chroma_share": blend_share(chroma)}

    def reference(self, image: Floats, given: ReferenceContext) -> Floats:
        planes = rgb_to_ycbcr(image)
        luma, chroma = (blend_share(amount) for amount in self.amounts)
        y, c = planes[..., :1], planes[..., 1:]
        y = y + luma * (self.window(y, self.reaches[0]) - y)
        c = c + chroma * (self.window(c, self.reaches[1]) - c)
        return ycbcr_to_rgb(np.concatenate([y, c], axis=-1))
