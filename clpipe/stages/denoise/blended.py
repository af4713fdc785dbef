"""What the mean and the median have in common: filters that do not look at the noise."""

from collections.abc import Mapping
from typing import ClassVar

import numpy as np

from clpipe.base.types import Floats
from clpipe.reference.colour import rgb_to_ycbcr, ycbcr_to_rgb
from clpipe.stage import Context, Frame
from clpipe.stages.denoise.strength import Denoiser

DETAIL = 0.02  # signal units: how far detail is taken to stand out from its neighbours


def share_of(amount: float) -> np.float32:
    """How much of such a filter is used: s^2 / (s^2 + t^2).

    Wiener's shrinkage (Lee, IEEE PAMI 1980) with one variance of detail, t = 0.02, for all
    pictures; s is ``amount``, strength times noise.

    >>> [round(float(share_of(s)), 2) for s in (0, 0.002, 0.01, 0.05)]
    [0.0, 0.01, 0.2, 0.86]
    """
    return np.float32(amount**2 / (amount**2 + DETAIL**2))


class BlendedFilter(Denoiser):
    """centre + share * (filtered - centre), the share as the noise asks for."""

    names: ClassVar = ("luma_share", "chroma_share")

    def window(self, image: Floats, reach: int) -> Floats:
        """The filter: (height, width, plane) in and out, over windows of 2*reach + 1."""
        raise NotImplementedError(type(self).__name__)

    @property
    def effect(self) -> str:
        luma, chroma = (f"{share_of(amount):.0%}" for amount in self.amounts)
        law = f"share = s^2 / (s^2 + {DETAIL:g}^2), s = strength * noise"
        return f"{law}: luma {luma}, chroma {chroma}"

    def numbers(self, context: Context) -> Mapping[str, np.float32]:
        luma, chroma = self.amounts
        return {"luma_share": share_of(luma), "chroma_share": share_of(chroma)}

    def reference(self, image: Floats, frame: Frame) -> Floats:
        planes = rgb_to_ycbcr(image)
        luma, chroma = (share_of(amount) for amount in self.amounts)
        y, c = planes[..., :1], planes[..., 1:]
        y = y + luma * (self.window(y, self.reaches[0]) - y)
        c = c + chroma * (self.window(c, self.reaches[1]) - c)
        return ycbcr_to_rgb(np.concatenate([y, c], axis=-1))
