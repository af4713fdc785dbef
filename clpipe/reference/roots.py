"""Square roots of the signal, as ``kernels/lib/roots.h`` has them.

Shot noise grows as the root of the signal, so in roots it has the same size at all levels (Anscombe
1948), as it has nearly in a finished picture, whose encoding for a display is close to a root. The
offset, in signal units, keeps the slope of the root finite at black.
"""

import numpy as np

from clpipe.base.types import Floats


def root_of(signal: Floats, offset: np.float32) -> Floats:
    """The root of a signal of any shape, 0 for all below -offset."""
    return np.sqrt(np.maximum(signal + offset, np.float32(0)))


def from_root(root: Floats, offset: np.float32) -> Floats:
    """The inverse of :func:`root_of`; -offset for all roots below 0, as sums of colours can be.

    >>> offset = np.float32(0.01)
    >>> from_root(root_of(np.float32([0, 0.25, 1]), offset), offset).round(6).tolist()
    [0.0, 0.25, 1.0]
    >>> from_root(np.float32([-0.5]), offset).round(6).tolist()
    [-0.009999999776482582]
    """
    return np.square(np.maximum(root, np.float32(0))) - offset


def noise_in_roots(sigma: float, level: float, offset: float) -> float:
    """The standard deviation in roots of noise of ``sigma`` at a level, all in signal units.

    >>> round(noise_in_roots(0.01, 0.24, 0.01), 6)
    0.01
    """
    return float(sigma / (2 * np.sqrt(level + offset)))
