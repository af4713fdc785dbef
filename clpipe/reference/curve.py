"""One-dimensional curves as tables, like in ``kernels/lib/curve.h``.

The index is the upper part of the float's bits: 20 octaves below 1, with 4096 steps each. A value
takes the nearest entry (relative error at most 2^-13). Two curves can be composed to one table with
the same results, bit for bit, as two look-ups in sequence.
"""

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from clpipe.base.types import Array, Doubles, Floats

OCTAVES, STEPS = 20, 4096
SIZE = OCTAVES * STEPS + 1
_SMALLEST = np.float32(2.0**-OCTAVES)
_FIRST = int(_SMALLEST.view(np.int32)) >> 11


def curve_index(values: Floats) -> NDArray[np.int32]:
    """Return the index of the nearest table entry: 0 below 2^-20, the last above 1.

    >>> curve_index(np.float32([-1, 0, 2**-20, 0.5, 1, 7])).tolist()
    [0, 0, 0, 77824, 81920, 81920]
    """
    inside = np.minimum(np.maximum(np.nan_to_num(values), _SMALLEST), np.float32(1))
    return ((inside.view(np.int32) + np.int32(0x400)) >> np.int32(11)) - np.int32(_FIRST)


def tabulate(function: Callable[[Doubles], Doubles]) -> Floats:
    """Return the table of a function on 0..1, (:data:`SIZE`,).

    Each entry is the function's value at that entry's float; entry 0 is its value at 0.
    """
    points = ((np.arange(SIZE, dtype=np.int32) + _FIRST) << 11).view(np.float32).astype(np.float64)
    points[0] = 0
    return function(points).astype(np.float32)


def compose(first: Floats, second: Array) -> Array:
    """Return one table for a look-up in ``first`` and then in ``second``."""
    return second[curve_index(first)]


def to_8_bit(values: Floats) -> NDArray[np.uint8]:
    """Convert 0..1 to 0..255, rounded to nearest (ties to even) and clipped; NaN becomes 0."""
    return _scaled(values, 255).astype(np.uint8)


def to_16_bit(values: Floats) -> NDArray[np.uint16]:
    """Convert 0..1 to 0..65535, otherwise like :func:`to_8_bit`.

    >>> to_16_bit(np.float32([-1, 0.25, 1, 7])).tolist()
    [0, 16384, 65535, 65535]
    """
    return _scaled(values, 65535).astype(np.uint16)


def _scaled(values: Floats, largest: int) -> Floats:
    clipped = np.minimum(np.maximum(np.nan_to_num(values), np.float32(0)), np.float32(1))
    return np.rint(clipped * np.float32(largest))
