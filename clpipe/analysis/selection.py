"""Selection: the pixels that clipping does not distort."""

import numpy as np

from clpipe.analysis.intensity import bin_of
from clpipe.base.types import Doubles, Floats, Mask

# The share of a bin's samples from which clipping distorts its statistics: a choice;
# tests/test_statistics.py shows what it selects.
CLIPPED = 1e-3


def select_unclipped(intensity: Floats, clipped: Mask, edges: Doubles, start: Mask) -> Mask:
    """The pixels of ``start`` at intensities where clipping does not distort the noise.

    Leaving out the clipped samples alone would leave a one-sided distribution. So an intensity bin
    is left out where more than :data:`CLIPPED` of its samples are clipped; in the other bins, each
    pixel that is clipped in any frame is left out.

    Args:
        intensity: (height, width).
        clipped: (frame, height, width), True where a sample is clipped.
        edges: of the intensity bins.
        start: (height, width), the pixels to select from.
    """
    index = bin_of(intensity, edges)
    size = len(edges) - 1
    count = np.bincount(index[start], minlength=size)
    lost = np.bincount(index[start], clipped.mean(0)[start], minlength=size)
    whole = lost <= CLIPPED * count
    return start & whole[index] & ~clipped.any(0)
