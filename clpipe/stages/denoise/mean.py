"""The mean of a window."""

from collections.abc import Mapping
from typing import ClassVar

import numpy as np

from clpipe.reference.colour import rgb_to_ycbcr, ycbcr_to_rgb
from clpipe.reference.image import tap
from clpipe.stage import Context, Frame
from clpipe.stages.denoise.law import Denoiser
from clpipe.types import Floats

DETAIL = 0.01  # signal units: how far detail is taken to stand out from its neighbours


def share_of(amount: float) -> np.float32:
    """How much of a filter that does not look at the noise is used: s^2 / (s^2 + t^2).

    Wiener's shrinkage (Lee, IEEE PAMI 1980, eq. 9) with one variance of detail, t = 0.01, for all
    pictures; s is ``amount``, strength times noise.

    >>> [round(float(share_of(s)), 2) for s in (0, 0.002, 0.01, 0.05)]
    [0.0, 0.04, 0.5, 0.96]
    """
    return np.float32(amount**2 / (amount**2 + DETAIL**2))


class Mean(Denoiser):
    """Mean of a square window, mixed with the pixel itself as the noise asks for.

    It does not know an edge from noise; it is here to compare with.
    """

    method: ClassVar = "mean"
    kernel: ClassVar = "denoise_mean"
    summary: ClassVar = "mean of a window, more of it the more noise there is"
    tolerance: ClassVar = 2e-6  # sums come in another order
    function: ClassVar = "mean_filter"
    names: ClassVar = ("luma_share", "chroma_share")
    block: ClassVar = 1

    def numbers(self, context: Context) -> Mapping[str, np.float32]:
        luma, chroma = self.amounts
        return {"luma_share": share_of(luma), "chroma_share": share_of(chroma)}

    def reference(self, image: Floats, frame: Frame) -> Floats:
        planes = rgb_to_ycbcr(image)
        numbers = self.numbers(frame.context)
        luma, chroma = (box(planes, reach) for reach in self.reaches)
        filtered = np.concatenate([luma[..., :1], chroma[..., 1:]], axis=-1)
        shares = [numbers["luma_share"], *[numbers["chroma_share"]] * 2]
        return ycbcr_to_rgb(planes + np.array(shares, np.float32) * (filtered - planes))


def box(image: Floats, reach: int) -> Floats:
    """Mean of the (2*reach + 1)^2 pixels around each pixel.

    >>> box(np.float32([[1, 1, 4, 1]]), 1).tolist()
    [[1.0, 2.0, 2.0, 3.0]]
    """
    offsets = range(-reach, reach + 1)
    rows = sum((tap(image, 0, dy) for dy in offsets), np.zeros_like(image))
    total = sum((tap(rows, dx, 0) for dx in offsets), np.zeros_like(image))
    return total * np.float32(1 / len(offsets) ** 2)
