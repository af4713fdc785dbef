"""A compiled kernel with its arguments, and how many work items it is launched over."""

from collections.abc import Callable, Mapping
from typing import Any

import numpy as np

from clpipe.base.types import Array
from clpipe.engine.bindings import (
    ArgumentValue,
    Bind,
    Buffer,
    EncodedCurves,
    ExtentNumber,
    ResamplingValue,
    StreamWord,
    TileNumber,
    Value,
)
from clpipe.engine.buffers import Pool
from clpipe.engine.extents import Extent, Extents
from clpipe.engine.ir import Border, Finalize, Histogram, Kernel, Launch, Lines, Reduce
from clpipe.engine.work_items import PARTIALS, columns_of, local_size, round_up, summed_together

ENDS = ("src", "dst")  # buffers that are an image's own

MANY = 4  # launches, after which there will be more


def index_space(kernel: Kernel, extent: Extent) -> tuple[tuple[int, ...], tuple[int, ...]]:
    """The global and the local size of a kernel, in work items."""
    lanes, local = extent.lanes, local_size(extent.lanes)
    match kernel.launch:
        case Launch(rows=rows) as launch:
            wide = lanes * columns_of(launch, lanes)
            blocks = round_up(-(-extent.padded_width // wide), local)
            return (blocks, -(-extent.stored.height // rows)), (local, 1)
        case Border():
            wide = extent.stored.width + 2 * extent.border
            high = extent.stored.height + 2 * extent.border
            return (round_up(wide, local), high), (local, 1)
        case Finalize():
            return (1,), (1,)
        case Lines():
            items = round_up(max(extent.width, extent.height), lanes) // lanes
        case Histogram():
            items = PARTIALS * summed_together(lanes)
        case Reduce(op=op):
            items = op.reduction.bins if lanes == 1 and op.reduction.bins else PARTIALS
    return (round_up(items, local),), (local,)


class Call:
    """A compiled kernel with its arguments, most of which stay from launch to launch.

    Attributes:
        reads_source: whether it reads the image that is sent.
        reads: the names of buffers that stay on the device, of those that it only reads.
        writes: of those that it writes.
        values: what an image's chain gives.
    """

    def __init__(self, kernel: Kernel, compiled: Any) -> None:
        self.kernel = kernel
        self.compiled = compiled
        self.reads: list[str] = []
        self.writes: list[str] = []
        self._ends: list[tuple[int, str]] = []
        self._buffers: list[tuple[int, str]] = []
        self._tile: list[int] = []
        self._own: list[tuple[int, str]] = []  # numbers of the extent
        self._larger: list[tuple[int, str]] = []
        self._values: list[tuple[int, Value]] = []
        for i, parameter in enumerate(kernel.parameters):
            match parameter.bound:
                case Buffer(name) if name in ENDS:
                    self._ends.append((i, name))
                case Buffer(name, written):
                    self._buffers.append((i, name))
                    (self.writes if written else self.reads).append(name)
                case ExtentNumber(name, larger):
                    (self._larger if larger else self._own).append((i, name))
                case TileNumber():
                    self._tile.append(i)
                case ArgumentValue() | StreamWord() | EncodedCurves() | ResamplingValue() as value:
                    self._values.append((i, value))
        self.values = [value for _, value in self._values]
        self.reads_source = "src" in (name for _, name in self._ends)
        self._arguments: list[Any] = [None] * len(kernel.parameters)
        self._extents: Extents = ()
        self._bound: tuple[Any, ...] = ()
        self._launches = 0

    def set_arguments(
        self,
        pool: Pool,
        ends: Mapping[str, Any],
        extents: Extents,
        tile: int,
        bind: Bind,
        table: Callable[[Array], Any],
    ) -> None:
        """Set the arguments of the next launch.

        Args:
            pool: the buffers that stay.
            ends: the buffers "src" and "dst", which are an image's own.
            extents: the tile's.
            tile: its number.
            bind: gives the values, always the same ones.
            table: a buffer that holds an array.
        """
        arguments = self._arguments
        for i, name in self._ends:
            arguments[i] = ends[name]
        for i in self._tile:
            arguments[i] = np.uint32(tile)
        if extents is not self._extents:
            level = self.kernel.launch.level
            for names, of in ((self._own, level), (self._larger, max(level - 1, 0))):
                for i, name in names:
                    arguments[i] = extents[of].numbers[name]
            self._extents = extents
        for i, name in self._buffers:
            arguments[i] = pool.buffers[name]
        if (pool.generation, bind) != self._bound:
            for i, asked in self._values:
                value = bind(asked)
                arguments[i] = table(value) if isinstance(value, np.ndarray) else value
            self._bound = pool.generation, bind
        # PyOpenCL takes 11 us to find out the type of a number, or 2 ms to be told all types.
        self._launches += 1
        if self._launches == MANY:
            self.compiled.set_arg_types([getattr(each, "dtype", None) for each in arguments])
        self.compiled.set_args(*arguments)
        for i, _ in (*self._ends, *self._buffers):
            arguments[i] = None  # which would hold an image, or a buffer that has been given back
