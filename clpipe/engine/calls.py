"""A compiled kernel with its arguments, and how many work items it is launched over."""

from collections.abc import Callable, Mapping
from typing import Any

import numpy as np

from clpipe.base.types import Array
from clpipe.engine.buffers import Pool, buffer_name
from clpipe.engine.codegen import (
    PARTIALS,
    Border,
    Kernel,
    columns_of,
    local_size,
    round_up,
    summed_together,
)
from clpipe.engine.extents import Extent, Extents
from clpipe.engine.plan import Finalize, Histogram, Launch, Lines, Reduce
from clpipe.engine.writer import Parameter

Bind = Callable[[Parameter], Any]

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
            items = op.pass_.bins if lanes == 1 and op.pass_.bins else PARTIALS
    return (round_up(items, local),), (local,)


class Call:
    """A compiled kernel with its arguments, most of which stay from launch to launch.

    Attributes:
        reads_source: whether it reads the image that is sent.
        reads: the names of buffers that stay on the device, of those that it only reads.
        writes: of those that it writes.
        values: the parameters whose values an image's chain gives.
    """

    def __init__(self, kernel: Kernel, compiled: Any) -> None:
        self.kernel = kernel
        self.compiled = compiled
        numbered = list(enumerate(kernel.parameters))
        names = [(i, buffer_name(p)) for i, p in numbered]
        self._ends = [(i, name) for i, name in names if name in ("src", "dst")]
        self._buffers = [(i, name) for i, name in names if name and name not in ("src", "dst")]
        is_read = {name: "const " in kernel.parameters[i].declaration for i, name in names}
        self.reads_source = "src" in is_read
        self.reads = [name for _, name in self._buffers if is_read[name]]
        self.writes = [name for _, name in self._buffers if not is_read[name]]
        tiles = [(i, p.item) for i, p in numbered if p.role == "tile"]
        self._tile = [i for i, name in tiles if name == "tile"]
        self._larger = [(i, name[5:]) for i, name in tiles if name.startswith("from_")]
        others = {*self._tile, *(i for i, _ in self._larger)}
        self._own = [(i, name) for i, name in tiles if i not in others]
        self._values = [(i, p) for i, p in numbered if p.role in ("value", "key", "table8", "taps")]
        self.values = [p for _, p in self._values]
        self._arguments: list[Any] = [None] * len(numbered)
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
            bind: the value of a parameter, always the same one.
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
            arguments[i] = pool.held[name]
        if (pool.generation, bind) != self._bound:
            for i, parameter in self._values:
                value = bind(parameter)
                arguments[i] = table(value) if isinstance(value, np.ndarray) else value
            self._bound = pool.generation, bind
        # PyOpenCL takes 11 us to find out the type of a number, or 2 ms to be told all types.
        self._launches += 1
        if self._launches == MANY:
            self.compiled.set_arg_types([getattr(each, "dtype", None) for each in arguments])
        self.compiled.set_args(*arguments)
        for i, _ in (*self._ends, *self._buffers):
            arguments[i] = None  # which would hold an image, or a buffer that has been given back
