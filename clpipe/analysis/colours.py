"""Noise in saturated colours, where the weak channel may be denoised more than the strong one."""

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from clpipe.base.types import Mask

BRIGHT = 60  # levels, which the strongest channel exceeds
SATURATION = 0.5  # the smallest difference of the channels, as a share of the strongest
MIN_SAMPLES = 500  # pixels that the figure needs


@dataclass(frozen=True, eq=False)
class Saturated:
    """The flat pixels of saturated colours, (height, width), and the numbers of two channels.

    ``weak`` is the channel with the lowest mean over all of these pixels, ``strong`` the one with
    the highest.
    """

    mask: Mask
    weak: int
    strong: int

    def within(self, mask: Mask) -> "Saturated":
        """Return the pixels restricted to a mask, with the same channels."""
        return Saturated(self.mask & mask, self.weak, self.strong)

    def ratio(self, noise: NDArray[np.floating[Any]]) -> float:
        """Return the sigma of noise in the weak channel over that in the strong one.

        It is NaN with fewer than 500 pixels.

        Args:
            noise: (frame, height, width, 3).
        """
        if self.mask.sum() < MIN_SAMPLES:
            return math.nan
        samples = noise[:, self.mask]
        weak, strong = (float(samples[..., c].std()) for c in (self.weak, self.strong))
        return weak / strong if strong else math.nan


def saturated_of(mean: NDArray[np.number], mask: Mask) -> Saturated:
    """Return the pixels of a mask with a saturated colour.

    Args:
        mean: the picture without noise, (height, width, 3), 0 to 255.
        mask: the flat pixels, (height, width).

    >>> reds = np.broadcast_to([[[200.0, 30, 60]], [[200.0, 120, 130]]], (2, 4, 3))
    >>> found = saturated_of(reds, np.ones((2, 4), bool))
    >>> found.mask.tolist()[0], found.mask.any(1).tolist(), found.weak, found.strong
    ([True, True, True, True], [True, False], 1, 0)
    """
    high, low = mean.max(-1), mean.min(-1)
    saturated = mask & (high > BRIGHT) & (high - low > SATURATION * high)
    levels = mean[saturated].sum(0)
    return Saturated(saturated, int(levels.argmin()), int(levels.argmax()))
