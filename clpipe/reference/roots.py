"""Square roots of the signal, like in ``kernels/lib/roots.h``.

Shot noise grows with the root of the signal, so in roots it has the same size at all levels
(Anscombe 1948). In a finished image this is nearly true as well, because its display encoding is
close to a root. The offset, in signal units, keeps the slope of the root finite at black.
"""

import numpy as np

from clpipe.base.types import Floats


def root_of(signal: Floats, offset: np.float32) -> Floats:
    """Return the root of a signal of any shape, 0 for all values below -offset."""
    return np.sqrt(np.maximum(signal + offset, np.float32(0)))


def from_root(root: Floats, offset: np.float32) -> Floats:
    """Return the inverse of :func:`root_of`; -offset for roots below 0, from sums of colours.

    >>> offset = np.float32(0.01)
    >>> from_root(root_of(np.float32([0, 0.25, 1]), offset), offset).round(6).tolist()
    [0.0, 0.25, 1.0]
    >>> from_root(np.float32([-0.5]), offset).round(6).tolist()
    [-0.009999999776482582]
    """
    return np.square(np.maximum(root, np.float32(0))) - offset


def in_steps(root: Floats) -> Floats:
    """Return roots in steps of 2^-20, from 0 on.

    They do not change if they are squared and the root is taken again. A result from an image's
    roots therefore has the same bits as one from its light.

    >>> roots, offset = in_steps(np.linspace(0, 1.2, 9999, dtype=np.float32)), np.float32(0.007)
    >>> np.array_equal(in_steps(root_of(from_root(roots, offset), offset)), roots)
    True
    """
    return (np.maximum(root, np.float32(0)) + np.float32(12)) - np.float32(12)


def noise_in_roots(sigma: float, level: float, offset: float) -> float:
    """Return the standard deviation in roots of noise of ``sigma`` at a level, in signal units.

    >>> round(float(noise_in_roots(0.01, 0.24, 0.01)), 6)
    0.01
    """
    return sigma / (2 * np.sqrt(level + offset))
