"""A compiled kernel with its arguments, and how many work items it is launched over."""

from collections.abc import Callable, Mapping
from typing import Any

import numpy as np

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
    """A compiled kernel that remembers its arguments.

    Setting an argument takes time, and most stay the same from image to image.
    """

    def __init__(self, kernel: Kernel, compiled: Any) -> None:
        self.kernel = kernel
        self.compiled = compiled
        numbered = list(enumerate(kernel.parameters))
        names = [(i, buffer_name(p)) for i, p in numbered]
        self._ends = [(i, name) for i, name in names if name in ("src", "dst")]
        self._buffers = [(i, name) for i, name in names if name and name not in ("src", "dst")]
        self._numbers = [(i, p.item) for i, p in numbered if p.role == "tile"]
        self._values = [(i, p) for i, p in numbered if p.role in ("value", "key", "table8", "taps")]
        self._last: list[Any] = [None] * len(numbered)
        self._place: tuple[Any, ...] = ()

    def set_arguments(
        self, pool: Pool, ends: Mapping[str, Any], extents: Extents, tile: int, bind: Bind
    ) -> None:
        """Set the arguments that differ from the last launch: buffers, a tile's numbers, values.

        ``ends`` are the buffers "src" and "dst", which are an image's own.
        """
        for i, name in self._ends:
            self.compiled.set_arg(i, ends[name])
        place = pool.generation, extents, tile
        if place != self._place:
            level = self.kernel.launch.level
            larger = extents[max(level - 1, 0)].numbers
            numbers = {
                **extents[level].numbers,
                **{f"from_{name}": number for name, number in larger.items()},
                "tile": np.uint32(tile),
            }
            for i, name in self._buffers:
                self.compiled.set_arg(i, pool.held[name])
            for i, name in self._numbers:
                self.compiled.set_arg(i, numbers[name])
            self._place = place
        for i, parameter in self._values:
            value, last = bind(parameter), self._last[i]
            if value is not last and not same_bits(value, last):
                self.compiled.set_arg(i, value)
                self._last[i] = value


def same_bits(one: Any, two: Any) -> bool:
    """Whether two NumPy scalars have the same bits, which 0 and -0 do not."""
    scalars = isinstance(one, np.generic) and isinstance(two, np.generic)
    return scalars and one.tobytes() == two.tobytes()
