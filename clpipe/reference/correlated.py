"""Normals that are correlated between channels, like in ``kernels/lib/correlated.h``."""

import math

import numpy as np

from clpipe.base.types import Floats
from clpipe.reference.random import Stream, normal_at

TOLERANCE = 1e-6  # a measured and rounded correlation may exceed the possible range by this much


def mixing(red_green: float, red_blue: float, green_blue: float) -> tuple[np.float32, ...]:
    """Return the Cholesky factor of the correlation of red, green and blue.

    It is the lower triangle L with L L' the correlation, without its first entry, which is 1:
    green_red, green_green, blue_red, blue_green, blue_blue.

    >>> [float(x) for x in mixing(0.0, 0.0, 0.0)]
    [0.0, 1.0, 0.0, 0.0, 1.0]

    Raises:
        ValueError: no three channels have these correlations.
    """
    green = math.sqrt(max(1 - red_green**2, 0.0))
    rest = green_blue - red_green * red_blue
    shared = rest / green if green > TOLERANCE else 0.0
    remaining = 1 - red_blue**2 - shared**2
    if remaining < -TOLERANCE or (green <= TOLERANCE < abs(rest)):
        raise ValueError("no three channels can be correlated like this")
    return tuple(
        map(np.float32, (red_green, green, red_blue, shared, math.sqrt(max(remaining, 0.0))))
    )


def correlated_normals(
    shape: tuple[int, ...], stream: Stream, mix: tuple[np.float32, ...]
) -> Floats:
    """Return standard normals for red, green and blue, (height, width, 3), with a correlation.

    ``shape`` begins with height and width.
    """
    n0, n1, n2 = (normal_at(shape, draw, stream) for draw in range(3))
    green_red, green_green, blue_red, blue_green, blue_blue = mix
    green = n0 * green_red + n1 * green_green
    return np.stack([n0, green, n0 * blue_red + n1 * blue_green + n2 * blue_blue], axis=-1)
