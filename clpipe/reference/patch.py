"""Distances between 3x3 patches, for non-local means.

The abbreviation "IPOL 2011" stands for Buades, Coll and Morel, "Non-Local Means Denoising", Image
Processing On Line 1, 2011. The kernels have their own blocked form in ``kernels/lib/patch.h``.
"""

from collections.abc import Iterator
from math import e, log2

import numpy as np

from clpipe.base.types import Floats
from clpipe.reference.image import mirrored, tap


def patch_distances(planes: Floats, reach: int, step: int = 1) -> Iterator[tuple[int, int, Floats]]:
    """Yield squared distances between the 3x3 patches of pixels in a window (IPOL 2011, eq. 2).

    Args:
        planes: (height, width, plane).
        reach: largest offset in the window, px.
        step: distance between offsets, px.

    Yields:
        For each offset, dx, dy and the squared differences summed over patch and planes, (height,
        width).

    >>> step = np.float32([[[0], [0], [0], [1], [1], [1]]])
    >>> {dx: d[0].tolist() for dx, dy, d in patch_distances(step, 1) if dy == 0}[1]
    [0.0, 3.0, 3.0, 3.0, 0.0, 0.0]
    """
    height, width = planes.shape[:2]
    padded = mirrored(planes, reach + 1)
    centre = padded[reach:, reach:][: height + 2, : width + 2]
    offsets = range(-reach, reach + 1, step)
    for dx, dy in ((dx, dy) for dy in offsets for dx in offsets):
        other = padded[reach + dy :, reach + dx :][: height + 2, : width + 2]
        squared = ((other - centre) ** 2).sum(-1)
        down = squared[:-2] + squared[1:-1] + squared[2:]
        yield dx, dy, down[:, :-2] + down[:, 1:-1] + down[:, 2:]


def bias_of(strength: float) -> np.float32:
    """Return the squared distance expected from noise alone, in units of its variance.

    It is 2, since the difference of two samples has the variance 2 sigma^2 (IPOL 2011, sec. 3). A
    ``strength`` below 1 scales sigma down.
    """
    return np.float32(2 * min(strength, 1) ** 2)


def decay_of(h: float) -> np.float32:
    """Return the factor c for which exp(-distance / h^2) = 2^(c * distance)."""
    return np.float32(-log2(e) / max(h, 1e-3) ** 2)


def patch_sum(image: Floats) -> Floats:
    """Return the sum of the 3x3 pixels around each pixel of a plane; (height, width) in and out.

    >>> patch_sum(np.float32([[1, 2, 4]])).tolist()
    [[15.0, 21.0, 24.0]]
    """
    rows = tap(image, -1, 0) + image + tap(image, 1, 0)
    return tap(rows, 0, -1) + rows + tap(rows, 0, 1)
