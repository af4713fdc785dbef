"""Noise at edges, which cameras smooth less than other areas, and sharpen."""

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from clpipe.base.types import Mask

FLATTEST, STEEPEST = 25, 90  # percentiles of the gradient: flat below the first, steep above
BINOMIAL = np.array([1, 4, 6, 4, 1]) / 16  # smooths luma like a Gaussian of 1 px
REACH = len(BINOMIAL) // 2
MIN_SAMPLES = 500  # pixels that flat areas and steep areas each need


@dataclass(frozen=True, eq=False)
class Slopes:
    """Masks of the flattest and the steepest pixels of a picture, (height, width) each."""

    flat: Mask
    steep: Mask

    def within(self, mask: Mask) -> "Slopes":
        """Return the slopes restricted to a mask."""
        return Slopes(self.flat & mask, self.steep & mask)

    def ratio(self, noise: NDArray[np.floating[Any]]) -> float:
        """Return the rms of noise in steep pixels over that in flat pixels.

        It is NaN with fewer than 500 pixels of either.

        Args:
            noise: the noise of luma, (frame, height, width).
        """
        if min(self.flat.sum(), self.steep.sum()) < MIN_SAMPLES:
            return math.nan
        flat, steep = (float((noise[:, mask] ** 2).mean()) for mask in (self.flat, self.steep))
        return math.sqrt(steep / flat) if flat > 0 else math.nan


def slopes_of(luma: NDArray[np.floating[Any]], mask: Mask) -> Slopes:
    """Return the flattest quarter and the steepest tenth of the pixels of a mask.

    Args:
        luma: luma without noise, (height, width).
        mask: the valid pixels, which are neither clipped nor moving, (height, width).

    >>> ramp = np.add.outer(np.zeros(100), np.arange(100.0) ** 2)
    >>> slopes = slopes_of(ramp, np.ones((100, 100), bool))
    >>> int(slopes.flat[50].sum()), int(slopes.steep[50].sum())
    (25, 10)
    """
    if not mask.any() or min(luma.shape) < len(BINOMIAL):
        return Slopes(np.zeros_like(mask), np.zeros_like(mask))
    smooth = np.asarray(luma, np.float64)
    for _ in range(2):  # along each axis
        wide = np.pad(smooth, ((REACH, REACH), (0, 0)), "edge")
        windows = np.lib.stride_tricks.sliding_window_view(wide, len(BINOMIAL), axis=0)
        smooth = (windows @ BINOMIAL).T
    steepness = np.hypot(*np.gradient(smooth))
    low, high = np.percentile(steepness[mask], [FLATTEST, STEEPEST])
    return Slopes(mask & (steepness <= low), mask & (steepness >= high))
