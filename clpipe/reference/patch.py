"""Distances of patches, for non-local means."""

from collections.abc import Iterator
from math import e, log2

import numpy as np

from clpipe.base.types import Floats
from clpipe.reference.image import mirrored, tap


def patch_distances(planes: Floats, reach: int, step: int = 1) -> Iterator[tuple[int, int, Floats]]:
    """Squared distances of each pixel's 3x3 patch from those in its window (IPOL 2011, eq. 2).

    ``planes`` is (height, width, plane). For each offset dx, dy of the window, ``step`` px apart,
    the sum over patch and planes comes as (height, width).

    >>> step = np.float32([[[0], [0], [0], [1], [1], [1]]])
    >>> {dx: d[0].tolist() for dx, dy, d in patch_distances(step, 1) if dy == 0}[1]
    [0.0, 3.0, 3.0, 3.0, 0.0, 0.0]
    """
    height, width = planes.shape[:2]
    around = mirrored(planes, reach + 1)
    centre = around[reach:, reach:][: height + 2, : width + 2]
    offsets = range(-reach, reach + 1, step)
    for dx, dy in ((dx, dy) for dy in offsets for dx in offsets):
        other = around[reach + dy :, reach + dx :][: height + 2, : width + 2]
        squared = ((other - centre) ** 2).sum(-1)
        down = squared[:-2] + squared[1:-1] + squared[2:]
        yield dx, dy, down[:, :-2] + down[:, 1:-1] + down[:, 2:]


def bias_of(strength: float) -> np.float32:
    """What noise alone makes of a distance in units of its variance (IPOL 2011, section 3).

    Two samples of noise differ by 2 sigma^2 in the mean. A strength below 1 takes sigma to be less.
    """
    return np.float32(2 * min(strength, 1) ** 2)


def decay_of(h: float) -> np.float32:
    """What a distance is multiplied by to get the log2 of its weight, exp(-distance / h^2)."""
    return np.float32(-log2(e) / max(h, 1e-3) ** 2)


def patch_sum(image: Floats) -> Floats:
    """Sum over the 3x3 pixels around each pixel of a (height, width) plane.

    >>> patch_sum(np.float32([[1, 2, 4]])).tolist()
    [[15.0, 21.0, 24.0]]
    """
    rows = tap(image, -1, 0) + image + tap(image, 1, 0)
    return tap(rows, 0, -1) + rows + tap(rows, 0, 1)
