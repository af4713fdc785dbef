"""Warped images: each pixel is gathered with a filter from the position that a lens sees.

The map is computed exactly at the nodes of a grid. Between them it is interpolated with cubic
polynomials (Lagrange's, through four nodes), in float32 and in the kernel's order. The grid is as
coarse as possible with an error below :data:`MAX_ERROR` at the centres of its cells.
"""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from functools import cached_property, lru_cache, reduce
from operator import add
from typing import Any, ClassVar

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view

from clpipe.base.errors import ImageError
from clpipe.base.types import Array, Floats
from clpipe.reference.image import mirrored
from clpipe.reference.lens import DistortionMap
from clpipe.reference.radial import Radial
from clpipe.reference.resample import Axis, Parameters, lanczos3

MAX_ERROR = 0.003  # px; the largest error of the map at the centre of a cell
STEPS = (64, 32, 16, 8, 4, 2, 1)  # px; possible distances between nodes
MAX_NODES = 2**22
FIELDS = 8  # values of a node: x and y of red, green and blue, and two for alignment


def _catmull_rom() -> Floats:
    """Return the four weights as polynomials of the fraction (Keys 1981, a=-1/2)."""
    halves = [[0, -1, 2, -1], [2, 0, -5, 3], [0, 1, 4, -3], [0, 0, -1, 1]]
    return np.array(halves, np.float32) / np.float32(2)


def _lanczos3() -> Floats:
    """Return the six weights, scaled to the sum 1, as least-squares polynomials of the fraction."""
    fraction = (1 - np.cos(np.pi * (np.arange(256) + 0.5) / 256)) / 2
    taps = np.arange(-2, 4)[:, None]
    weights = lanczos3(fraction - taps, 1.0)
    weights = weights / weights.sum(0)
    powers = np.vander(fraction, 8, increasing=True)
    return np.ascontiguousarray(np.linalg.lstsq(powers, weights.T)[0].T, np.float32)


# For each filter, the coefficients of each tap's weight, (tap, power of the fraction). The first of
# `count` taps is 1 - count / 2 pixels away.
FILTERS: dict[str, Floats] = {"bicubic": _catmull_rom(), "lanczos3": _lanczos3()}


@dataclass(frozen=True, eq=False)
class Grid:
    """The map of an image on nodes ``step`` px apart, the first at its first pixel's centre.

    ``nodes`` are (row, column, field) float32: the offset in px from a pixel to the position in the
    input that it shows, across and down, for red, green and blue.
    """

    step: int
    nodes: Floats

    @cached_property
    def flat(self) -> Floats:
        """The nodes in the kernel's layout."""
        return np.ascontiguousarray(self.nodes).reshape(-1)

    def at(self, positions: Array, axis: int) -> tuple[Array, list[Floats]]:
        """Return, for rows (axis 0) or columns, the first of four adjacent nodes, and weights."""
        first = np.clip(positions // self.step - 1, 0, self.nodes.shape[axis] - 4)
        t = (positions - first * self.step).astype(np.float32) * np.float32(1 / self.step)
        return first, lagrange(t)

    def fields(self, rows: Array, columns: Array) -> Iterator[Floats]:
        """Return each field at these rows and columns, (row, column) float32, like the kernel."""
        first, weights = self.at(rows, 0)
        lines = reduce(
            add, (w[:, None, None] * self.nodes[first + k] for k, w in enumerate(weights))
        )
        first, weights = self.at(columns, 1)
        for field in range(6):
            field_lines = lines[:, :, field]
            yield reduce(add, (w * field_lines[:, first + k] for k, w in enumerate(weights)))


def lagrange(t: Floats) -> list[Floats]:
    """Return the weights of four nodes at 0, 1, 2 and 3 for a position t among them; float32.

    >>> [float(w) for w in lagrange(np.float32(1.5))]
    [-0.0625, 0.5625, 0.5625, -0.0625]
    """
    one, two, three = t - np.float32(1), t - np.float32(2), t - np.float32(3)
    sixth, half = np.float32(1 / 6), np.float32(0.5)
    return [
        one * two * three * -sixth,
        t * two * three * half,
        t * one * three * -half,
        t * one * two * sixth,
    ]


class GatherResampler:
    """A resampler that gathers each pixel at its own position, with one of :data:`FILTERS`."""

    filter: str

    @property
    def scale(self) -> float:
        """See :attr:`Resampler.scale`."""
        return 1.0

    @property
    def support(self) -> int:
        """The number of pixels on either side of a position that have a weight."""
        return len(FILTERS[self.filter]) // 2

    def lines(self, axis: Axis, width: int, height: int) -> tuple[Array, Array]:
        """Return the first and last old row, or column, that may contribute to each new one."""
        raise NotImplementedError(type(self).__name__)

    def needed(self, axis: Axis, size: tuple[int, int], start: int, stop: int) -> tuple[int, int]:
        """See :meth:`Resampler.needed`."""
        first, last = self.lines(axis, *size)
        return int(first[start:stop].min()), int(last[start:stop].max()) + 1

    def reach(self, axis: Axis, size: tuple[int, int], low: int, high: int) -> tuple[int, int]:
        """See :meth:`Resampler.reach`."""
        first, last = self.lines(axis, *size)
        input_size, output_size = size[1 if axis == "rows" else 0], len(first)
        line = np.arange(output_size) * input_size
        before = int((-(-line // output_size) - first).max())
        after = int((last - line // output_size).max())
        low, high = (-(-each * input_size // output_size) for each in (low, high))
        return max(low + before, 0), max(high + after + 1, 0)


def with_mirrored_lines(first: Array, last: Array, size: int, support: int) -> tuple[Array, Array]:
    """Return lines of an image, with those that its border mirrors, as many as the filter needs."""
    first = np.clip(np.minimum(first, size - 1 - support), 0, size - 1)
    last = np.clip(np.maximum(last, support), 0, size - 1)
    return first.astype(np.int64), last.astype(np.int64)


@dataclass(frozen=True)
class Warp(GatherResampler):
    """A lens as a resampling of the image, see :class:`clpipe.reference.resample.Resampler`.

    Args:
        lens: the lens.
        filter: a key of :data:`FILTERS`.
    """

    parameters: ClassVar[Parameters] = (
        ("nodes", "__global const float *restrict"),
        ("step", "uint"),
        ("share", "float"),
        ("across", "uint"),
        ("down", "uint"),
    )

    lens: DistortionMap
    filter: str

    def resized(self, width: int, height: int) -> tuple[int, int]:
        """See :meth:`Resampler.resized`."""
        return self.lens.size(width, height)

    def grid(self, width: int, height: int) -> Grid:
        """Return the map of an image of this size.

        Raises:
            ImageError: the lens folds the image over, or nearly.
        """
        return _grid(self.lens, width, height)

    def values(self, width: int, height: int) -> Mapping[str, Any]:
        """See :meth:`Resampler.values`."""
        grid = self.grid(width, height)
        down, across = grid.nodes.shape[:2]
        counts = {"step": grid.step, "across": across, "down": down}
        numbers = {name: np.uint32(n) for name, n in counts.items()}
        return {"nodes": grid.flat, "share": np.float32(1 / grid.step), **numbers}

    def lines(self, axis: Axis, width: int, height: int) -> tuple[Array, Array]:
        return _lines(self, axis, width, height)

    def reference(self, image: Floats) -> Floats:
        """Return the warped image, (height, width, 3) float32; black where the lens sees none."""
        height, width = image.shape[:2]
        columns, rows = self.resized(width, height)
        fields = self.grid(width, height).fields(np.arange(rows), np.arange(columns))
        result = np.empty((rows, columns, 3), np.float32)
        for channel, offsets in enumerate(zip(fields, fields, strict=True)):
            result[..., channel] = gather(image[..., channel], *offsets, FILTERS[self.filter])
        return result


def gather(plane: Floats, across: Floats, down: Floats, polynomials: Floats) -> Floats:
    """Return a channel at positions between its pixels; 0 outside it.

    Args:
        plane: (height, width) float32.
        across: the horizontal offset of each pixel of the result from its position, px; float32.
        down: its vertical offset, px; float32.
        polynomials: those of the filter's weights, (tap, power), in :data:`FILTERS`.
    """
    height, width = plane.shape
    rows, columns = across.shape
    padded = mirrored(plane, len(polynomials) // 2)
    column, across = _split(across, np.arange(columns))
    row, down = _split(down, np.arange(rows)[:, None])
    inside = _is_inside(column, across, width) & _is_inside(row, down, height)
    column, row = np.clip(column, -1, width - 1), np.clip(row, -1, height - 1)
    total = np.zeros((rows, columns), np.float32)
    for j, of_row in enumerate(polynomials):
        line = np.zeros((rows, columns), np.float32)
        for k, of_column in enumerate(polynomials):
            line = line + _horner(of_column, across) * padded[row + (j + 1), column + (k + 1)]
        total = total + _horner(of_row, down) * line
    return np.where(inside, total, np.float32(0))


def _split(distance: Floats, line: Array) -> tuple[Array, Floats]:
    """Return the pixel before the position at an offset, and the remaining fraction."""
    whole = np.floor(distance)
    return line + whole.astype(np.int32), distance - whole


def _is_inside(pixel: Array, fraction: Floats, size: int) -> Array:
    """Return whether a position is in the image, up to the edges of its pixels."""
    low = (pixel >= 0) | ((pixel == -1) & (fraction >= np.float32(0.5)))
    return low & ((pixel < size - 1) | ((pixel == size - 1) & (fraction <= np.float32(0.5))))


def _horner(polynomial: Floats, x: Floats) -> Floats:
    total = np.full_like(x, polynomial[-1])
    for coefficient in polynomial[-2::-1]:
        total = total * x + coefficient
    return total


@lru_cache(maxsize=16)
def _grid(lens: DistortionMap, width: int, height: int) -> Grid:
    for step in STEPS:
        down, across = (max(-(-size // step) + 1, 4) for size in lens.size(width, height)[::-1])
        if down * across > MAX_NODES:
            break
        nodes = np.zeros((down, across, FIELDS), np.float32)
        rows, columns = np.arange(down) * step, np.arange(across) * step
        for field, distances in enumerate(_distances(lens, width, height, rows, columns)):
            nodes[..., field] = distances
        grid = Grid(step, nodes)
        if step == 1 or _error(lens, width, height, grid) <= MAX_ERROR:
            return grid
    raise ImageError(
        f"distortion: the map of {width}x{height} pixels bends too sharply to be interpolated; "
        "these coefficients nearly fold the image over, so use smaller ones"
    )


def _distances(
    lens: DistortionMap, width: int, height: int, rows: Array, columns: Array
) -> Iterator[Array]:
    """Return the fields of a grid at these rows and columns, exactly: (row, column) float64."""
    x, y = columns + 0.5, rows[:, None] + 0.5
    x, y = np.broadcast_arrays(x, y)
    green: tuple[Array, Array] | None = None
    for lateral in (lens.red, Radial(), lens.blue):
        if lateral.is_identity:
            green = green or lens.source_positions(x, y, width, height)
        position = (
            green
            if lateral.is_identity and green
            else lens.source_positions(x, y, width, height, lateral)
        )
        yield position[0] - x
        yield position[1] - y


def _error(lens: DistortionMap, width: int, height: int, grid: Grid) -> float:
    """Return the error in px of a grid at the centres of its cells, where the lens sees it."""
    rows, columns = (
        np.minimum(np.arange(0, size, grid.step) + grid.step // 2, size - 1)
        for size in lens.size(width, height)[::-1]
    )
    exact = _distances(lens, width, height, rows, columns)
    near = grid.fields(rows, columns)
    largest = 0.0
    pairs = zip(exact, near, strict=True)
    for (dx, near_dx), (dy, near_dy) in zip(pairs, pairs, strict=True):
        x, y = dx + columns, dy + rows[:, None]
        is_visible = (x > -2) & (x < width + 1) & (y > -2) & (y < height + 1)
        error = np.hypot(near_dx - dx, near_dy - dy)
        largest = max(largest, float(error[is_visible].max(initial=0)))
    return largest


# For cubic interpolation between four nodes in each of two dimensions. The magnitudes of the
# weights sum to at most 1.632 in each dimension. A value exceeds those of the nodes by at most this
# share of their range.
OVERSHOOT = (1.632**2 - 1) / 2


@lru_cache(maxsize=32)
def _lines(warp: Warp, axis: Axis, width: int, height: int) -> tuple[Array, Array]:
    """See :meth:`GatherResampler.lines`."""
    grid, support = warp.grid(width, height), warp.support
    sizes = warp.resized(width, height)
    # How far pixels between 4x4 nodes sample to each side, for all channels.
    windows = sliding_window_view(grid.nodes[..., :6], (4, 4), (0, 1))
    low, high = windows.min((-2, -1)), windows.max((-2, -1))
    overshoot = OVERSHOOT * (high - low) + 0.01
    low, high = (np.floor(each) for each in (low - overshoot, high + overshoot))
    visible = []
    for number, size in enumerate((width, height)):
        begin = np.arange(low.shape[1 - number]) * grid.step
        end = np.minimum(begin + 3 * grid.step, sizes[number] - 1)
        shape = (1, -1) if number == 0 else (-1, 1)
        first = begin.reshape(shape) + low[..., number::2].min(-1)
        last = end.reshape(shape) + high[..., number::2].max(-1)
        visible.append((last >= -1) & (first <= size))
    is_visible = visible[0] & visible[1]  # invisible pixels see no part of the image
    number, size = (1, height) if axis == "rows" else (0, width)
    least = np.where(is_visible, low[..., number::2].min(-1), np.inf).min(number)
    most = np.where(is_visible, high[..., number::2].max(-1), -np.inf).max(number)
    line = np.arange(sizes[number])
    window = np.clip(line // grid.step - 1, 0, len(least) - 1)
    same = line + (warp.lens.margins.top if axis == "rows" else warp.lens.margins.left)
    first = np.where(np.isinf(least[window]), same, line + least[window] - (support - 1))
    last = np.where(np.isinf(most[window]), same, line + most[window] + support)
    return with_mirrored_lines(first, last, size, support)
