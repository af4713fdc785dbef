"""The median filter, like in ``kernels/lib/median.h``."""

import numpy as np

from clpipe.base.types import Floats
from clpipe.reference.image import tap


def median_filter(image: Floats, size: int) -> Floats:
    """Return the median of ``size`` x ``size`` pixels around each pixel, mirrored at the borders.

    ``image`` is (height, width) or (height, width, plane). Each plane is filtered separately, and
    the result has the same shape.

    >>> median_filter(np.float32([[1, 9, 2, 3, 4]]), 3).tolist()
    [[9.0, 2.0, 3.0, 3.0, 3.0]]
    """
    reach = range(-(size // 2), size // 2 + 1)
    window = [tap(image, dx, dy) for dy in reach for dx in reach]
    return np.median(np.stack(window), axis=0).astype(np.float32)
