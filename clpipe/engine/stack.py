"""Stacks: images, tiles or patches (members) that share launches, each with different values.

A launch costs a few microseconds on the host, and a small image leaves a GPU mostly idle. Therefore
the members of a stack are launched together, in buffers that contain all of them. The results are
bit for bit those of separate launches. Kernels read the numbers that differ between members from a
table with a row for each member; see :func:`~clpipe.engine.kernel_builder.kernel_opening`. A large
image is a stack of one.
"""

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from operator import itemgetter
from typing import Any

import numpy as np

from clpipe.base.types import Array
from clpipe.engine.bands import strip_of, strips_of
from clpipe.engine.bindings import (
    ArgumentValue,
    Buffer,
    EncodedCurves,
    ExtentNumber,
    ResamplingValue,
    StreamWord,
    StripNumber,
    TileNumber,
    Value,
)
from clpipe.engine.buffers import PAGE
from clpipe.engine.extents import Extent, Extents, enclosing
from clpipe.engine.ir import Border, Finalize, Histogram, Kernel, Launch, Lines, Reduce
from clpipe.engine.kernel_builder import element_type
from clpipe.engine.patches import check_memory
from clpipe.engine.tiles import buffer_sizes
from clpipe.engine.work import Member
from clpipe.engine.work_items import PARTIALS, columns_of, local_size, round_up, summed_together

IO_BUFFERS = ("src", "dst")  # the buffers of an image's source and eight-bit result

# The most bytes of a stack's buffers, by whether the device uses host memory directly. On a CPU,
# stacks are twice as fast as single launches for images of 128x128 pixels, and a third faster for
# 256x256. They are a tenth slower for 512x512, which do not stay in the cache between two launches.
MAX_STACK_BYTES = {True: 2**24, False: 2**29}
ELEMENT_BYTES = {"uchar": 1, "half": 2, "float": 4, "uint": 4, "int4": 16, "long4": 32}
BYTES_PER_PIXEL = 36  # bytes of the default chain's buffers per pixel
MIN_MEMBERS = 4  # members of a stack; with fewer, images are so large that launches hardly matter
# The types of a table's last columns, in this order.
SCALAR_TYPES = {"float": np.float32, "int": np.int32, "uint": np.uint32}


class Call:
    """A compiled kernel, and the layout of its table's rows.

    Attributes:
        reads_source: whether it reads the source.
        reads: the names of the buffers that it only reads, without "src" and "dst".
        writes: the names of the buffers that it writes to, without "src" and "dst".
        values: the values that depend on the image's chain.
    """

    def __init__(self, kernel: Kernel, compiled: Any) -> None:
        self.kernel = kernel
        self.compiled = compiled
        self.reads: list[str] = []
        self.writes: list[str] = []
        self.values: list[Value] = []
        self._pointers: list[tuple[int, str | int]] = []  # column; buffer, or index into values
        self._elements: dict[int, int] = {}  # column of a buffer -> bytes of an element
        self._numbers: dict[bool, list[str]] = {False: [], True: []}  # by of_input
        self._scalars: dict[str, list[int]] = {
            type_: [] for type_ in SCALAR_TYPES
        }  # indices into values
        self._tile: int | None = None
        self._strips: dict[str, int] = {}
        for column, parameter in enumerate(kernel.parameters):
            element = element_type(parameter)
            match parameter.binding:
                case Buffer(name, written):
                    self._pointers.append((column, name))
                    self._elements[column] = ELEMENT_BYTES[str(element)]
                    if name not in IO_BUFFERS:
                        (self.writes if written else self.reads).append(name)
                case ExtentNumber(name, of_input):
                    self._numbers[of_input].append(name)
                case TileNumber():
                    self._tile = column
                case StripNumber(name):
                    self._strips[name] = column
                case ArgumentValue() | StreamWord() | EncodedCurves() | ResamplingValue() as value:
                    if element:
                        self._pointers.append((column, len(self.values)))
                    else:
                        self._scalars[parameter.declaration.split()[0]].append(len(self.values))
                    self.values.append(value)
        self.reads_source = any(name == "src" for _, name in self._pointers)
        self._last_single: tuple[Extents, Array] = (
            (),
            np.zeros(0, np.uint32),
        )  # of the last single one

    def table(
        self,
        stack: "Stack",
        values: Sequence[Sequence[Any]],
        buffers: Mapping[str, Any],
        cached_buffer: Callable[[Array], Any],
        new_buffer: Callable[[Array], Any],
    ) -> tuple[Array, list[Any]]:
        """Return the table of a stack, and the buffers that are the kernel's other arguments.

        Args:
            stack: the stack.
            values: the values of each member.
            buffers: the buffers on the device, by name.
            cached_buffer: returns a buffer with an array's contents, one per array object.
            new_buffer: returns a new buffer with an array's contents.

        Returns:
            The table, (member, column) uint32, and the buffers.
        """
        rows = self._extent_table(stack)
        if self._tile is not None:
            rows[:, self._tile] = stack.tile
        if self._strips:
            largest = enclosing([member.extents for member in stack.members])
            launch = self.kernel.launch
            assert isinstance(launch, Launch) and launch.bands
            size = strip_of(launch.bands, largest[launch.level])
            rows[:, self._strips["columns"]], rows[:, self._strips["rows"]] = size
        end = rows.shape[1]
        for type_, numbers in reversed(self._scalars.items()):  # they are the last columns
            if numbers:
                columns = np.array(
                    [[member_values[n] for n in numbers] for member_values in values],
                    SCALAR_TYPES[type_],
                )
                rows[:, end - len(numbers) : end] = columns.view(np.uint32)
                end -= len(numbers)
        pointers = []
        for column, name in self._pointers:
            if isinstance(name, str):
                pointers.append(buffers[name])
            else:
                arrays = [member_values[name] for member_values in values]
                array, rows[:, column] = pad_and_join(arrays)
                pointers.append((cached_buffer if array is arrays[0] else new_buffer)(array))
        return rows, pointers

    def _extent_table(self, stack: "Stack") -> Array:
        """Return a table with the numbers of the members' extents and their offsets in buffers."""
        members, is_single = stack.members, len(stack.members) == 1
        if is_single and members[0].extents is self._last_single[0]:
            return self._last_single[1].copy()
        rows = np.zeros((len(members), len(self.kernel.parameters)), np.uint32)
        level, first = self.kernel.launch.level, 0
        for of_input, names in self._numbers.items():
            if names:
                end = first + len(names)
                rows[:, first:end] = stack.numbers(max(level - of_input, 0), tuple(names))
                first = end
        for column, name in self._pointers:
            if isinstance(name, str):
                rows[:, column] = stack.strides.get(name, 0) // self._elements[column]
        if is_single:
            self._last_single = members[0].extents, rows.copy()
        return rows


@dataclass(frozen=True)
class Stack:
    """Members that share launches.

    Args:
        members: the members. Their plans may differ only in the scales of resamplings.
        calls: the launches, in order.
        borders: returns the calls that fill the borders of the planes written by a launch.
        strides: the bytes from one member to the next in each buffer.
        tile: the number of the tile, from 0.
        fetches: whether results are fetched. If not, the phase only measures the image.
        is_last: whether the estimates from the image are also fetched.
    """

    members: Sequence[Member]
    calls: Sequence[Call]
    borders: Callable[[Launch], Iterator[Call]]
    strides: Mapping[str, int]
    tile: int = 0
    fetches: bool = True
    is_last: bool = True
    _numbers: dict[Any, list[Any]] = field(default_factory=dict, init=False)

    def numbers(self, level: int, names: tuple[str, ...]) -> list[Any]:
        """Return numbers of the members' extents on a level, one row per member."""
        if (level, names) not in self._numbers:
            select = itemgetter(*names)
            rows = [select(member.extents[level].numbers) for member in self.members]
            self._numbers[level, names] = rows
        return self._numbers[level, names]

    def launches(self) -> Iterator[tuple[Call, tuple[int, ...], tuple[int, ...]]]:
        """Yield the kernels to launch, each with its global and local size in work items."""
        parts = [member.extents for member in self.members]
        are_small = [any(e.is_small for e in level) for level in zip(*parts, strict=True)]
        largest = enclosing(parts)
        for call in self.calls:
            launch = call.kernel.launch
            extent = largest[launch.level]
            if extent.is_empty:
                continue
            calls = [call]
            if isinstance(launch, Launch) and (launch.has_period or are_small[launch.level]):
                calls += self.borders(launch)
            for each in calls:
                global_size, local_size = index_space(each.kernel, extent)
                ones = (1,) * (2 - len(global_size))
                yield each, (*global_size, *ones, len(self.members)), (*local_size, *ones, 1)


def index_space(kernel: Kernel, extent: Extent) -> tuple[tuple[int, ...], tuple[int, ...]]:
    """Return the global and the local size of a kernel for one member, in work items."""
    lanes, local = extent.lanes, local_size(extent.lanes)
    match kernel.launch:
        case Launch(bands=bands) if bands:
            return strips_of(bands, extent), (1, 1)
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


def divide_into_stacks(
    members: Sequence[Member], zero_copy: bool, memory: int, largest: int, depth: int
) -> Iterator[tuple[Sequence[Member], Mapping[str, int], Mapping[str, int]]]:
    """Divide members into stacks that fit into memory.

    Each member is a separate stack, without strides, if fewer than :data:`MIN_MEMBERS` would fit,
    or if some members are empty on levels where others are not.

    Args:
        members: the members, all of one plan.
        zero_copy: whether the device uses host memory directly.
        memory: the most bytes that all buffers together may use.
        largest: the most bytes of a single buffer.
        depth: the number of sources and results that exist at a time.

    Yields:
        The members of each stack, with the strides and the sizes of its buffers in bytes.

    Raises:
        ImageError: a single member does not fit into the memory.
    """
    strides: dict[str, int] = {}
    count = 1
    if len(members) > 1:
        largest_member = enclosing([member.extents for member in members])
        sizes_of_one = buffer_sizes(members[0].work.plan, largest_member, depth)
        strides = {name: round_up(size, PAGE) for name, size in sizes_of_one.items()}
        allowed = min(MAX_STACK_BYTES[zero_copy], memory)
        count = min(allowed // sum(strides.values()), largest // max(strides.values()))
    is_mixed = len({tuple(extent.is_empty for extent in m.extents) for m in members}) > 1
    if count < MIN_MEMBERS or is_mixed:
        for member in members:
            sizes = buffer_sizes(member.work.plan, member.extents, depth)
            check_memory(sizes, memory)
            yield [member], {}, sizes
        return
    io_strides = {name: strides[f"{name}0"] for name in IO_BUFFERS if f"{name}0" in strides}
    for first in range(0, len(members), count):
        part = members[first : first + count]
        sizes = {name: stride * len(part) for name, stride in strides.items()}
        yield part, strides | io_strides, sizes


def pad_and_join(arrays: Sequence[Array]) -> tuple[Array, int]:
    """Return arrays in one array, padded to equal length, and this length.

    If all arrays are one object, return this object and 0.

    >>> pad_and_join([np.array([1, 2, 3]), np.array([4])])[0].tolist()
    [1, 2, 3, 4, 0, 0]
    """
    first = arrays[0]
    if all(array is first for array in arrays):
        return first, 0
    longest = max(array.size for array in arrays)
    joined = np.zeros((len(arrays), longest), first.dtype)
    for row, array in zip(joined, arrays, strict=True):
        row[: array.size] = array.reshape(-1)
    return joined.reshape(-1), longest
