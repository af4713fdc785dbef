"""Grids of marks in pictures: which mark is in which row and column."""

from collections import deque

import numpy as np
from numpy.typing import NDArray

from clpipe.base.types import Doubles

NEAR = 0.3  # of the distance of marks, within which the next one is expected


def numbered(points: Doubles, least: int) -> tuple[Doubles, NDArray[np.int64]] | None:
    """Return the marks that form a grid: their rows and columns, and their numbers.

    The grid grows from the mark nearest to the origin, and follows distortion and perspective.
    None if fewer than ``least`` marks form a grid.

    >>> y, x = np.mgrid[-1:2, -1:2] * 10.0
    >>> places, numbers = numbered(np.column_stack([y.ravel(), x.ravel()]), least=9)
    >>> places[numbers.tolist().index(0)].tolist()
    [-1.0, -1.0]

    Args:
        points: (mark, 2): y and x.
        least: the number of marks that a grid needs.
    """
    first = int(np.hypot(*points.T).argmin())
    order = np.argsort(np.hypot(*(points - points[first]).T))[1:9]
    one, *others = points[order] - points[first]
    length = np.hypot(*one)
    # The other axis is perpendicular, with marks about as far apart.
    two = min(others, key=lambda v: abs(v @ one) / length**2 + abs(np.hypot(*v) / length - 1))
    down, right = (one, two) if abs(one[0]) > abs(two[0]) else (two, one)
    right, down = right * np.sign(right[1]), down * np.sign(down[0])
    places = {first: (0, 0)}
    queue = deque([(first, down, right)])
    while queue:
        mark, down, right = queue.popleft()
        for step, vector in (((0, 1), right), ((0, -1), -right), ((1, 0), down), ((-1, 0), -down)):
            away = np.hypot(*(points - points[mark] - vector).T)
            other = int(away.argmin())
            if other in places or away[other] > NEAR * np.hypot(*vector):
                continue
            row, column = places[mark]
            places[other] = (row + step[0], column + step[1])
            moved = (points[other] - points[mark]) * sum(step)
            queue.append((other, moved if step[0] else down, moved if step[1] else right))
    if len(places) < least:
        return None
    return np.array(list(places.values()), np.float64), np.array(list(places))
