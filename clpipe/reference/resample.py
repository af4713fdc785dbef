"""Smaller images: the positions of their pixels in the larger one, and their weighted means.

A resampling reduces the rows or the columns of an image. Its ``shown`` lines, counted from the
first edge, become ``smaller`` lines. Position x becomes x * smaller / shown, in pixels from that
edge, also in depth maps and other layers. A :class:`Resampling` shows all lines, so the field of
view does not change. :class:`Bins` crops the lines after the last whole bin.
"""

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from functools import lru_cache
from typing import Any, ClassVar, Literal, Protocol

import numpy as np

from clpipe.base.types import Array, Floats

# The largest number of rows or columns after the image's last ones for which a kernel reads taps. A
# kernel reads them because its blocks and vectors are not cut.
PADDING = 16

# The weights of samples by their distance from the centre of the new pixel, in pixels of the larger
# image. A new pixel is ``ratio`` of these pixels wide.
Weight = Callable[[Array, float], Array]


Axis = Literal["rows", "columns"]


Parameters = tuple[tuple[str, str], ...]


class Resampler(Protocol):
    """How an image is made by gathering pixels of another.

    Its kernel arguments have the names and OpenCL types of ``parameters``, in that order.
    """

    parameters: ClassVar[Parameters]

    @property
    def scale(self) -> float:
        """Approximate number of pixels in the new image for each of the old one."""
        ...

    def resized(self, width: int, height: int) -> tuple[int, int]:
        """Return the width and height of the new image, from the old one's."""
        ...

    def values(self, width: int, height: int) -> Mapping[str, Any]:
        """Return the kernel's values by name, for an old image of this size; arrays are cached."""
        ...

    def needed(self, axis: Axis, size: tuple[int, int], start: int, stop: int) -> tuple[int, int]:
        """Return the range of old rows or columns that contribute to a range of new ones.

        ``size`` is the width and height of the old image.
        """
        ...

    def reach(self, axis: Axis, size: tuple[int, int], low: int, high: int) -> tuple[int, int]:
        """Return how many old rows or columns before and after a position new ones need at most.

        The new ones begin at most ``low`` before and end at most ``high`` after the same position.
        """
        ...


@dataclass(frozen=True, eq=False)
class Taps:
    """The lines of the larger image that contribute to each line of the smaller one.

    Line i is the sum of ``weights[i, k] * line(first[i] + k)``, with ``weights`` float32 (line,
    tap) of sum 1, and ``first`` int32. All of these lines are in the larger image. Both arrays
    repeat the last line :data:`PADDING` times. ``table`` contains ``weights`` in the kernel's
    layout.
    """

    first: Array
    weights: Floats
    table: Floats

    @property
    def count(self) -> int:
        """How many old lines contribute to each new one."""
        return int(self.weights.shape[1])

    @property
    def stride(self) -> int:
        """The length of a row of ``table``."""
        return int(self.table.shape[1])


class AxisResampler:
    """The base of resamplings that reduce rows or columns; see :class:`Resampler`."""

    parameters: ClassVar[Parameters] = (
        ("first", "__global const int *restrict"),
        ("table", "__global const float *restrict"),
        ("count", "uint"),
        ("stride", "uint"),
    )

    axis: Axis

    def size(self, size: int) -> int:
        """Return the new number of rows or columns, at least 1."""
        raise NotImplementedError(type(self).__name__)

    def shown(self, size: int) -> int:
        """Return how many of an image's rows or columns, from the first on, the new ones show."""
        return size

    def taps(self, size: int) -> Taps:
        """Return the taps of the new rows or columns of an image of ``size``."""
        raise NotImplementedError(type(self).__name__)

    def axis_length(self, width: int, height: int) -> int:
        """Return the side of an image that becomes shorter."""
        return height if self.axis == "rows" else width

    def resized(self, width: int, height: int) -> tuple[int, int]:
        """See :meth:`Resampler.resized`."""
        by_rows = self.axis == "rows"
        return (width, self.size(height)) if by_rows else (self.size(width), height)

    def values(self, width: int, height: int) -> Mapping[str, Any]:
        """See :meth:`Resampler.values`."""
        taps = self.taps(self.axis_length(width, height))
        counts = {"count": np.uint32(taps.count), "stride": np.uint32(taps.stride)}
        return {"first": taps.first, "table": taps.table, **counts}

    def needed(self, axis: Axis, size: tuple[int, int], start: int, stop: int) -> tuple[int, int]:
        """See :meth:`Resampler.needed`."""
        if axis != self.axis:
            return start, stop
        taps = self.taps(self.axis_length(*size))
        return int(taps.first[start]), int(taps.first[stop - 1]) + taps.count


@dataclass(frozen=True)
class Resampling(AxisResampler):
    """A reduction of the rows, or columns, of an image.

    Args:
        axis: rows or columns.
        scale: the new size over the old one, at most 1.
        weight: the filter.
        support: the largest distance with ``weight`` other than 0, over the ratio, minus 1/2 px.
    """

    axis: Axis
    scale: float
    weight: Weight
    support: float

    def size(self, size: int) -> int:
        """Return the new number of rows or columns: at least 1, with halves rounded up.

        >>> halved = Resampling("rows", 0.5, overlap, 0.5)
        >>> [halved.size(n) for n in (1, 2, 3, 4, 5)]
        [1, 1, 2, 2, 3]
        """
        return max(int(np.floor(size * self.scale + 0.5)), 1)

    def taps(self, size: int) -> Taps:
        """Return the taps of the new rows or columns of an image of ``size``."""
        return _taps(self, size)

    def reach(self, axis: Axis, size: tuple[int, int], low: int, high: int) -> tuple[int, int]:
        """See :meth:`Resampler.reach`."""
        if axis != self.axis:
            return low, high
        before = self.axis_length(*size)
        taps, after = self.taps(before).count + 1, self.size(before)
        return -(-low * before // after) + taps, -(-high * before // after) + taps


@dataclass(frozen=True)
class Bins(AxisResampler):
    """Binning: each new row, or column, is the mean of the next ``factor`` old ones.

    Lines after the last whole bin are cropped. A side that is shorter than a bin is one bin.
    """

    axis: Axis
    factor: int

    @property
    def scale(self) -> float:
        """See :attr:`Resampler.scale`."""
        return 1 / self.factor

    def size(self, size: int) -> int:
        """Return the new number of rows or columns.

        >>> [Bins("rows", 2).size(n) for n in (1, 2, 5)]
        [1, 1, 2]
        """
        return max(size // self.factor, 1)

    def shown(self, size: int) -> int:
        """See :meth:`AxisResampler.shown`.

        >>> [Bins("rows", 3).shown(n) for n in (2, 3, 8)]
        [2, 3, 6]
        """
        return self.size(size) * min(self.factor, size)

    def taps(self, size: int) -> Taps:
        """See :meth:`Resampling.taps`."""
        return _taps_of_bins(self, size)

    def reach(self, axis: Axis, size: tuple[int, int], low: int, high: int) -> tuple[int, int]:
        """See :meth:`Resampler.reach`."""
        if axis != self.axis:
            return low, high
        return (low + 1) * self.factor, (high + 1) * self.factor


def sizes(resamplings: Iterable[Resampler], width: int, height: int) -> tuple[tuple[int, int], ...]:
    """Return the width and height of an image, and after each of these resamplings in sequence.

    >>> halves = [Resampling(axis, 0.5, overlap, 0.5) for axis in ("rows", "columns")]
    >>> sizes(halves, 7, 5)
    ((7, 5), (7, 3), (4, 3))
    """
    found = [(width, height)]
    for each in resamplings:
        found.append(each.resized(*found[-1]))
    return tuple(found)


@lru_cache(maxsize=64)
def _taps(resampling: Resampling, size: int) -> Taps:
    count = resampling.size(size)
    ratio = size / count
    line = np.arange(count)[:, None]

    def weights(positions: Array) -> Array:
        # The distance between two centres, computed in whole numbers before the division.
        distance = (2 * positions * count - (2 * line + 1) * size + count) / (2 * count)
        return resampling.weight(distance, ratio)

    reach = int(np.ceil(resampling.support * ratio + 1))
    centre = (2 * line + 1) * size // (2 * count)
    candidates = centre + np.arange(-reach, reach + 1)
    has_weight = (weights(candidates) != 0) & (candidates >= 0) & (candidates < size)
    lowest = np.where(has_weight, candidates, size).min(1)
    width = int((np.where(has_weight, candidates, 0).max(1) - lowest).max()) + 1
    first = np.minimum(lowest, size - width)
    tap_weights = weights(first[:, None] + np.arange(width))
    tap_weights = (tap_weights / tap_weights.sum(1, keepdims=True)).astype(np.float32)
    return _padded_taps(resampling.axis, first, tap_weights)


@lru_cache(maxsize=64)
def _taps_of_bins(bins: Bins, size: int) -> Taps:
    count, factor = bins.size(size), min(bins.factor, size)
    tap_weights = np.full((count, factor), 1 / factor, np.float32)
    return _padded_taps(bins.axis, np.arange(count) * factor, tap_weights)


def _padded_taps(axis: Axis, first: Array, tap_weights: Floats) -> Taps:
    """Return the taps of new lines, after which the last line is repeated."""
    padded = np.minimum(np.arange(len(first) + PADDING), len(first) - 1)
    tap_weights = tap_weights[padded]
    table = np.ascontiguousarray(tap_weights if axis == "rows" else tap_weights.T)
    return Taps(first[padded].astype(np.int32), tap_weights, table)


def overlap(distance: Array, ratio: float) -> Array:
    """Return the share of a pixel, one wide, within one of width ``ratio``: the area average.

    >>> overlap(np.array([0.0, 1.0, 1.5, 2.0]), 2.5).tolist()
    [1.0, 0.75, 0.25, 0.0]
    """
    inside = np.minimum(distance + 0.5, ratio / 2) - np.maximum(distance - 0.5, -ratio / 2)
    return np.maximum(inside, 0)


def lanczos3(distance: Array, ratio: float) -> Array:
    """Return sinc(x) * sinc(x / 3) for |x| < 3, x = distance / ratio.

    It is that of Duchon (J. Appl. Meteor. 1979). Stretched by the ratio, it removes frequencies
    that the smaller image cannot represent.

    >>> lanczos3(np.array([0.0, 1.0, 3.0, 6.0]), 2.0).round(3).tolist()
    [1.0, 0.608, -0.135, 0.0]
    """
    x = distance / ratio
    return np.where(np.abs(x) < 3, np.sinc(x) * np.sinc(x / 3), 0)


def resample(image: Floats, resampling: AxisResampler) -> Floats:
    """Return the smaller image, (height, width[, channel]) float32; taps are summed in order.

    >>> halved = Resampling("columns", 0.5, overlap, 0.5)
    >>> resample(np.float32([[1, 3, 5, 7]]), halved).tolist()
    [[2.0, 6.0]]
    """
    axis = 0 if resampling.axis == "rows" else 1
    taps = resampling.taps(image.shape[axis])
    size = resampling.size(image.shape[axis])
    shape = (-1, *(1,) * (image.ndim - 1 - axis))
    total: Floats = np.zeros((), np.float32)
    for k in range(taps.count):
        weight = taps.weights[:size, k].reshape(shape)
        total = total + weight * image.take(taps.first[:size] + k, axis)
    return total
