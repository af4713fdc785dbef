"""Neighbouring pixels of a layer that show one surface, so that it may be interpolated there."""

from dataclasses import dataclass
from typing import Any

import numpy as np

from clpipe.base.types import Array, Mask

# A slope that is steeper by this factor than both adjacent slopes is an edge between surfaces.
EDGE_STEEPNESS = 3.0


@dataclass(frozen=True)
class Tolerance:
    """The allowed difference of neighbours on one surface: absolute, and relative."""

    absolute: float = 0.0
    relative: float = 0.0


# Tolerances for inverse depth (which is linear on a plane), for normals, and for flow in px.
DEPTH, NORMAL, FLOW = Tolerance(relative=1e-3), Tolerance(absolute=0.02), Tolerance(absolute=0.05)


def cells(values: Array, tolerance: Tolerance | None) -> Mask:
    """Return for each pixel corner whether the four pixels around it show one surface.

    Two neighbours show one surface if they hardly differ, or differ no more than the slope of the
    surrounding pixels explains. A NaN pixel shows no surface.

    Args:
        values: (rows, columns, channel).
        tolerance: None for labels, which are equal or not.

    Returns:
        (rows + 1, columns + 1): the corner at (row, column) is between the pixels (row - 1, column
        - 1) and (row, column). Edge pixels are repeated outside.

    >>> slope, edge = np.array([[4.0, 3, 2, 1]]), np.array([[4.0, 4, 2, 2]])
    >>> cells(slope[..., None], DEPTH)[0].all(), cells(edge[..., None], DEPTH)[0].tolist()
    (np.True_, [True, True, False, True, True])
    """
    across = _linked(values, tolerance)
    down = _linked(values.swapaxes(0, 1), tolerance).swapaxes(0, 1)
    padded = np.pad(across, ((1, 1), (1, 1)), constant_values=True)
    padded[0, 1:-1], padded[-1, 1:-1] = across[0], across[-1]
    joined = padded[:-1] & padded[1:]
    padded = np.pad(down, ((1, 1), (1, 1)), constant_values=True)
    padded[1:-1, 0], padded[1:-1, -1] = down[:, 0], down[:, -1]
    return np.asarray(joined & padded[:, :-1] & padded[:, 1:])


def _linked(values: Array, tolerance: Tolerance | None) -> Mask:
    """Return whether each pixel shows one surface with the next in its row: (rows, columns - 1)."""
    if tolerance is None:
        return np.asarray((values[:, 1:] == values[:, :-1]).all(-1))
    if values.shape[1] == 1:
        return np.zeros((len(values), 0), bool)
    with np.errstate(invalid="ignore"):
        step = values[:, 1:] - values[:, :-1]
        larger = np.maximum(abs(values[:, 1:]), abs(values[:, :-1]))
        size = abs(step)
        near = size <= tolerance.absolute + tolerance.relative * larger
        mode: Any = "reflect" if step.shape[1] > 1 else "constant"
        padded = np.pad(step, ((0, 0), (1, 1), (0, 0)), mode=mode)
        adjacent = np.minimum(padded[:, :-2] * np.sign(step), padded[:, 2:] * np.sign(step))
        expected = size <= EDGE_STEEPNESS * adjacent
        return np.asarray((near | expected).all(-1) & np.isfinite(step).all(-1))
