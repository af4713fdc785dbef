"""Selects the pixels whose noise is not distorted by clipping."""

import numpy as np

from clpipe.analysis.intensity import bin_of
from clpipe.base.types import Doubles, Floats, Mask

# Statistics of a bin are distorted if more than this share of its samples are clipped. We chose the
# value; tests/test_statistics.py shows its effect.
CLIPPED = 1e-3


def select_unclipped(intensity: Floats, clipped: Mask, edges: Doubles, start: Mask) -> Mask:
    """Return the pixels of ``start`` at intensities where clipping does not distort the noise.

    Excluding only clipped samples would leave a one-sided distribution. Therefore an intensity bin
    is excluded if more than :data:`CLIPPED` of its samples are clipped. In other bins, each pixel
    that is clipped in any frame is excluded.

    Args:
        intensity: (height, width).
        clipped: True for clipped samples, (frame, height, width).
        edges: edges of the intensity bins.
        start: the pixels to select from, (height, width).
    """
    index = bin_of(intensity, edges)
    size = len(edges) - 1
    count = np.bincount(index[start], minlength=size)
    lost = np.bincount(index[start], clipped.mean(0)[start], minlength=size)
    whole = lost <= CLIPPED * count
    return start & whole[index] & ~clipped.any(0)
