"""Companding: DN to fewer DN by a piecewise linear curve (PWL), for HDR sensors."""

from collections.abc import Sequence
from functools import lru_cache
from itertools import pairwise

import numpy as np

from clpipe.base.types import Doubles, Floats

Knots = tuple[tuple[float, float], ...]

# Octaves between the end knots of the default curve. Each piece is a quarter as long as the next.
OCTAVES = 7


def default_knots(white: float, result: float) -> Knots:
    """Return knots close to a square root, where shot noise has one size: (DN, result).

    >>> default_knots(16384, 128)[:3], default_knots(16384, 128)[-1]
    (((0.0, 0.0), (1.0, 1.0), (4.0, 2.0)), (16384.0, 128.0))
    """
    inner = [
        (round(white / 4.0**i), round(result / 2.0**i))
        for i in reversed(range(OCTAVES + 1))
        if result / 2.0**i >= 1
    ]
    return ((0.0, 0.0), *((float(x), float(y)) for x, y in inner))


def parse_knots(pairs: Sequence[Sequence[float]]) -> Knots:
    """Return knots from pairs of numbers.

    Raises:
        ValueError: they are not pairs, do not begin at 0, or do not rise.

    >>> parse_knots([[0, 0], [1023, 511], [4095, 1023]])[1]
    (1023.0, 511.0)
    """
    are_pairs = len(pairs) > 1 and all(len(pair) == 2 for pair in pairs)
    knots = tuple((float(pair[0]), float(pair[-1])) for pair in pairs) if are_pairs else ()
    rising = all(a[0] < b[0] and a[1] < b[1] for a, b in pairwise(knots))
    if not are_pairs or not rising or knots[0] != (0, 0):
        raise ValueError(
            f"knots: found {pairs}; expected pairs [DN before, DN after] that start at "
            "[0, 0] and increase in both"
        )
    return knots


@lru_cache(maxsize=64)  # equal knots share one object, so that it is uploaded once
def pieces_of(knots: Knots, inverse: bool = False) -> Floats:
    """Return the pieces between knots, or their inverse: start, value there, slope; (piece, 3)."""
    points: Doubles = np.array(knots)[:, ::-1] if inverse else np.array(knots)
    slopes = np.diff(points[:, 1]) / np.diff(points[:, 0])
    return np.ascontiguousarray(np.column_stack([points[:-1], slopes]), np.float32)


def apply_pieces(x: Floats, pieces: Floats) -> Floats:
    """Return the curve at these values.

    >>> apply_pieces(np.float32([1, 3]), pieces_of(((0, 0), (2, 2), (4, 3)))).tolist()
    [1.0, 2.5]
    """
    begin, value, slope = pieces[0]
    result = value + (x - begin) * slope
    for begin, value, slope in pieces[1:]:
        result = np.where(x >= begin, value + (x - begin) * slope, result)
    return np.asarray(result, np.float32)
