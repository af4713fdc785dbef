"""Noise at edges: cameras spare edges when they smooth, and sharpen them."""

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from clpipe.base.types import Mask

FLATTEST, STEEPEST = 25, 90  # percentiles of the gradient: up to one, and from the other on
BINOMIAL = np.array([1, 4, 6, 4, 1]) / 16  # as wide as a Gaussian of 1 px: luma is smoothed
REACH = len(BINOMIAL) // 2
FEWEST = 500  # pixels of each


@dataclass(frozen=True, eq=False)
class Slopes:
    """Where a picture is flattest and where it is steepest, (height, width) each."""

    flat: Mask
    steep: Mask

    def within(self, mask: Mask) -> "Slopes":
        """Those of them that are in a mask."""
        return Slopes(self.flat & mask, self.steep & mask)

    def ratio(self, noise: NDArray[np.floating[Any]]) -> float:
        """The rms of noise where it is steepest over that where it is flattest.

        NaN with fewer than 500 pixels of one of them.

        Args:
            noise: of luma, (frame, height, width).
        """
        if min(self.flat.sum(), self.steep.sum()) < FEWEST:
            return math.nan
        flat, steep = (float((noise[:, mask] ** 2).mean()) for mask in (self.flat, self.steep))
        return math.sqrt(steep / flat) if flat > 0 else math.nan


def slopes_of(luma: NDArray[np.floating[Any]], mask: Mask) -> Slopes:
    """The flattest quarter and the steepest tenth of the pixels of a mask.

    Args:
        luma: without noise, (height, width).
        mask: the pixels that count: neither clipped nor moving.

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
