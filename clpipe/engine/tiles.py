"""Divides an image into tiles that fit into device memory, and computes buffer sizes. Pure.

A tile consists of a core, which is the part of the result that it computes, and a halo for stencils
to read. Cores begin at whole blocks of lanes and of four rows. Therefore each pixel has the same
position in its work item as in the whole image. Its noise, CFA phase and arithmetic are the same,
bit for bit.

A tile has an extent on each level of the plan. The cores of all tiles cover each level's image
exactly once. On each level, a tile stores the pixels that its core needs there, and those that it
needs for the next level.
"""

import math
from bisect import bisect_left
from collections.abc import Iterator, Sequence, Set
from dataclasses import dataclass, replace
from functools import lru_cache

from clpipe.base.errors import MemoryLimitError
from clpipe.base.memory import format_bytes
from clpipe.engine.bands import ring_bytes
from clpipe.engine.bindings import RINGS, slot_buffer, step_buffer
from clpipe.engine.extents import Box, Extent, Extents, whole_image
from clpipe.engine.ir import AnyLaunch, Finalize, Histogram, Launch, Lines, Plan, Reduce, reads_of
from clpipe.engine.ops import Op
from clpipe.engine.work_items import PARTIALS, RUN, columns_of, round_up
from clpipe.reference.resample import Axis

# Larger tiles are not faster, and allocating memory takes time. A render of 600 megapixels took
# 28 s in tiles of 1 GiB, and 39 s in tiles of 4 GiB (PoCL, two busy cores).
LARGEST_TILE = 2**30  # bytes


def source_bytes(plan: Plan, extent: Extent) -> int:
    """Return the bytes of the source that kernels may read: whole blocks, even past its end."""
    stored = extent.stored
    pixels = (extent.padded_height - 1) * stored.width + extent.padded_width
    return pixels * plan.source_bytes


def buffer_sizes(plan: Plan, extents: Extents, depth: int = 1) -> dict[str, int]:
    """Return the device buffers that a plan needs for an image or a tile, as bytes by name.

    ``depth`` is the number of sources and eight-bit results that exist at a time.
    """
    first, last = extents[0], extents[-1]
    sizes = {f"src{i}": source_bytes(plan, first) for i in range(depth)}
    for number, levels in enumerate(plan.levels_of_slots):
        sizes[slot_buffer(number)] = max(extents[level].plane_bytes for level in levels)
    if plan.encoded:
        encoded = last.stored.width * last.stored.height * len(plan.encoded.channels)
        sizes |= {f"dst{i}": encoded for i in range(depth)}
    for launch in plan.launches:
        match launch:
            case Lines(ops=ops, level=level):
                image, lanes = extents[level], first.lanes
                # Line tables cover the image, not the tile: whole blocks of rows, and one vector.
                longest = round_up(max(image.width, image.height), max(lanes, 4)) + 2 * lanes
                sizes |= {step_buffer(op.pass_.writes, op.step): longest * 4 for op in ops}
            case Launch(bands=bands, sums=sums, level=level):
                if bands:
                    sizes[RINGS] = max(ring_bytes(bands, extents[level]), sizes.get(RINGS, 0))
                if not sums:
                    continue
                sizes[step_buffer("sums", sums.step)] = extents[level].blocks * 16
                sizes[step_buffer("partials", sums.step)] = PARTIALS * 32
            case Histogram(op=op):
                bins = op.reduction.bins
                sizes[step_buffer("counts", op.step)] = PARTIALS * bins * 4
                sizes[step_buffer("histogram", op.step)] = (bins + -(-bins // RUN)) * 4
            case Finalize(op=op):
                sizes[step_buffer("estimates", op.step)] = 16
    return sizes


@dataclass(frozen=True)
class Phase:
    """The numbers of launches that run once before all tiles, for each tile, and once after."""

    first: tuple[int, ...]
    each: tuple[int, ...]
    last: tuple[int, ...]


@dataclass(frozen=True)
class Tiling:
    """How an image is processed: its tiles, its phases, and the sizes of its buffers.

    Attributes:
        tiles: the tiles of the image.
        phases: the phases, in order.
        sizes: the bytes of each buffer, by name.
        patches: the tiles of the last phase, if only patches of the result are computed.
    """

    tiles: tuple[Extents, ...]
    phases: tuple[Phase, ...]
    sizes: dict[str, int]
    patches: tuple[Extents, ...] = ()

    def tiles_of(self, phase: Phase) -> tuple[Extents, ...]:
        """Return the tiles that a phase processes."""
        return self.patches if self.patches and phase is self.phases[-1] else self.tiles

    @property
    def bytes(self) -> int:
        """The device memory of all buffers, in bytes."""
        return sum(self.sizes.values())


@lru_cache(maxsize=256)
def phases_of(plan: Plan) -> tuple[Phase, ...]:
    """Return the phases of a plan. Each phase is one pass over all tiles.

    A number that is estimated from the whole image ends a phase. Each phase but the last processes
    all tiles up to one reduction. The next phase starts again at the source.
    """
    numbered = tuple(enumerate(plan.launches))
    lines = tuple(i for i, launch in numbered if isinstance(launch, Lines))
    phases = []
    for end, finalize in numbered:
        if isinstance(finalize, Finalize):
            reduces = {i for i, launch in numbered if reduction_of(launch) is finalize.op}
            phases.append(Phase((), with_dependencies(plan, reduces), (end,)))
    results = {image.number for _, image in plan.kept}
    results |= {plan.final.number} if plan.final else set()
    ends = {
        i
        for i, launch in numbered
        if isinstance(launch, Launch)
        and (launch.encodes or (launch.writes and launch.writes.number in results))
    }
    phases.append(Phase((), with_dependencies(plan, ends), ()))
    return (replace(phases[0], first=lines), *phases[1:])


def reduction_of(launch: AnyLaunch) -> Op | None:
    """Return the reduction that a launch belongs to; None for a reduction's last launch."""
    if isinstance(launch, Launch):
        return launch.sums
    return launch.op if isinstance(launch, Histogram | Reduce) else None


def with_dependencies(plan: Plan, ends: set[int]) -> tuple[int, ...]:
    """Return the numbers of these launches and of all launches that they depend on."""
    images: set[int] = set()
    chosen = []
    for number, launch in reversed(tuple(enumerate(plan.launches))):
        writes = launch.writes if isinstance(launch, Launch) else None
        if number in ends or (writes and writes.number in images):
            chosen.append(number)
            images |= {read.image.number for read in reads_of(launch)}
    return tuple(reversed(chosen))


def halos_of(plan: Plan) -> tuple[int, ...]:
    """Return the halo of each level: the radius of all its stencils in a row, in pixels."""
    reach: dict[int, int] = {}  # of each stored image
    halos = [0] * (len(plan.resamplings) + 1)
    for launch in reversed(plan.alone):
        halo = 0
        if isinstance(launch, Launch):
            halo = reach.get(launch.writes.number, 0) if launch.writes else 0
            halo += launch.stencil.radius if launch.stencil else 0
            if not launch.reads or launch.reads[0].image.level < launch.level:
                halos[launch.level] = max(halos[launch.level], halo)
                halo = 0
        for read in reads_of(launch):
            reach[read.image.number] = max(reach.get(read.image.number, 0), halo)
    return tuple(halos)


class Cutter:
    """Cuts an image into tiles whose columns begin at multiples of ``column_step``, rows of 4."""

    def __init__(self, plan: Plan, width: int, height: int, lanes: int) -> None:
        self.whole = whole_image(plan, width, height, lanes)
        columns = (columns_of(launch, lanes) for launch in plan.alone)
        self.column_step = lanes * math.lcm(2, *columns)
        self._halos = halos_of(plan)
        self._resamplings = plan.resamplings
        self._sizes = plan.sizes(width, height)

    def spans(self, axis: Axis, begin: int, end: int) -> list[tuple[int, ...]]:
        """Return the rows or columns of a tile on each level.

        Args:
            axis: "rows" or "columns".
            begin: the first row or column of the core on level 0.
            end: one after the last row or column of the core on level 0.

        Returns:
            For each level, begin and end of the core, then begin and end of the stored part.
        """
        step = self.column_step if axis == "columns" else 4
        sizes = [e.width if axis == "columns" else e.height for e in self.whole]
        # Rounded up, so that the first tile's core is not empty on any level.
        cores = [
            (
                min(round_up(-(-begin * size // sizes[0]), step), size),
                min(round_up(-(-end * size // sizes[0]), step), size),
            )
            for size in sizes
        ]
        return self.spans_of(axis, cores)

    def spans_of(self, axis: Axis, cores: Sequence[tuple[int, int]]) -> list[tuple[int, ...]]:
        """Return the :meth:`spans` of a tile with any core on each level."""
        step = self.column_step if axis == "columns" else 4
        sizes = [e.width if axis == "columns" else e.height for e in self.whole]
        spans: list[tuple[int, ...]] = []
        low = high = 0  # the part of this level that the next one needs
        for level in reversed(range(len(sizes))):
            size, halo, core = sizes[level], self._halos[level], cores[level]
            if core[0] < core[1]:
                low, high = (min(low, core[0]), max(high, core[1])) if low < high else core
            if low < high:
                low, high = max(low - halo, 0), min(high + halo, size)
            spans.append((*core, low // step * step, high))
            if level and low < high:
                larger = self._sizes[level - 1]
                low, high = self._resamplings[level - 1].needed(axis, larger, low, high)
        return spans[::-1]

    def tile(self, left: int, top: int, columns: int, rows: int) -> Extents:
        """Return the tile with a core of this position and size on level 0, cut at the image."""
        width, height = self.whole[0].width, self.whole[0].height
        x_spans = self.spans("columns", left, min(left + columns, width))
        y_spans = self.spans("rows", top, min(top + rows, height))
        return self._extents(x_spans, y_spans)

    def patch(self, box: Box, levels: Set[int]) -> Extents:
        """Return the tile that computes only a part of the images of these levels."""
        all_levels = range(len(self.whole))
        x_spans = [(box.left, box.right) if level in levels else (0, 0) for level in all_levels]
        y_spans = [(box.top, box.bottom) if level in levels else (0, 0) for level in all_levels]
        return self._extents(self.spans_of("columns", x_spans), self.spans_of("rows", y_spans))

    def _extents(
        self, x_spans: Sequence[tuple[int, ...]], y_spans: Sequence[tuple[int, ...]]
    ) -> Extents:
        return tuple(
            Extent(
                extent.width,
                extent.height,
                extent.lanes,
                extent.border,
                core=Box(x[0], y[0], x[1], y[1]),
                stored=Box(x[2], y[2], x[3], y[3]),
            )
            for extent, x, y in zip(self.whole, x_spans, y_spans, strict=True)
        )

    def largest_tile(self, columns: int, rows: int) -> Extents:
        """Return the largest extents that a tile of this size can have on each level."""
        wide, high = self._longest("columns", columns), self._longest("rows", rows)
        boxes = [Box(0, 0, x, y) for x, y in zip(wide, high, strict=True)]
        pairs = zip(self.whole, boxes, strict=True)
        return tuple(replace(extent, core=box, stored=box) for extent, box in pairs)

    def _longest(self, axis: Axis, core: int) -> list[int]:
        """Return the most rows or columns that a tile can store on each level."""
        step = self.column_step if axis == "columns" else 4
        sizes = [e.width if axis == "columns" else e.height for e in self.whole]
        found = []
        low = high = 0  # what is needed before and after the position of the core of level 0
        for level in reversed(range(len(sizes))):
            size, halo = sizes[level], self._halos[level]
            rounding = step if level else 0
            low, high = low + halo, max(high, rounding) + halo
            length = -(-core * size // sizes[0]) + round_up(low, step) + rounding + high
            found.append(min(length, round_up(size, step)))
            if level:
                larger = self._sizes[level - 1]
                low, high = self._resamplings[level - 1].reach(axis, larger, low, high)
        return found[::-1]


@lru_cache(maxsize=64)
def cutter_of(plan: Plan, width: int, height: int, lanes: int) -> Cutter:
    """Return the cutter for an image size, a plan and the lanes of a device."""
    return Cutter(plan, width, height, lanes)


@lru_cache(maxsize=64)
def tiling_of(
    plan: Plan, width: int, height: int, lanes: int, memory: int, largest: int, depth: int = 1
) -> Tiling:
    """Return the tiling of an image for limited memory: whole if it fits, else in tiles.

    This chooses the tile size with the smallest share of halos. If shares differ by less than 2 %,
    it prefers fewer columns of tiles, because full rows are transferred in one piece.

    Args:
        plan: the plan.
        width: the width of the image in pixels.
        height: its height.
        lanes: the lanes of the device.
        memory: the most bytes that all buffers together may use.
        largest: the most bytes of a single buffer.
        depth: the number of sources and eight-bit results that exist at a time.

    Raises:
        ImageError: even the smallest tile does not fit. The message contains the required memory.
    """
    cutter = cutter_of(plan, width, height, lanes)
    whole, column_step = cutter.whole, cutter.column_step

    def fits(extents: Extents, memory: int) -> bool:
        sizes = buffer_sizes(plan, extents, depth).values()
        return sum(sizes) <= memory and max(sizes) <= largest

    if fits(whole, memory):
        all_launches = tuple(range(len(plan.launches)))
        return Tiling((whole,), (Phase((), all_launches, ()),), buffer_sizes(plan, whole, depth))
    tile_memory = min(memory, LARGEST_TILE)
    best: tuple[float, int, int] | None = None
    for columns in dict.fromkeys(
        round_up(-(-width // parts), column_step) for parts in divisions(-(-width // column_step))
    ):
        blocks = bisect_left(
            range(1, -(-height // 4) + 1),
            True,
            key=lambda n: not fits(cutter.largest_tile(columns, 4 * n), tile_memory),
        )
        if blocks:
            parts = -(-height // (4 * blocks))
            rows = round_up(-(-height // parts), 4)
            extent = cutter.largest_tile(columns, rows)[0].stored
            cost = extent.width * extent.height / (columns * rows)
            if best is None or cost < best[0] / 1.02:
                best = cost, columns, rows
    if best is None:
        smallest = cutter.largest_tile(column_step, 4)
        least, full = (buffer_sizes(plan, extents, depth) for extents in (smallest, whole))
        raise MemoryLimitError(
            f"{width}x{height} pixels need {format_bytes(sum(full.values()))} of device memory, or "
            f"{format_bytes(sum(least.values()))} in the smallest tiles, with a buffer of "
            f"{format_bytes(max(least.values()))}. The limit is {format_bytes(memory)}, with "
            f"buffers of at most {format_bytes(largest)}. Raise the memory limit, or use another "
            "device."
        )
    _, columns, rows = best
    tiles = tuple(
        cutter.tile(left, top, columns, rows)
        for top in range(0, height, rows)
        for left in range(0, width, columns)
    )
    return Tiling(
        tiles, phases_of(plan), buffer_sizes(plan, cutter.largest_tile(columns, rows), depth)
    )


def divisions(most: int) -> Iterator[int]:
    """Yield the numbers of tiles to try: all small ones, then in steps of about 10 %.

    >>> list(divisions(12))
    [1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 12]
    """
    parts = 1
    while parts < most:
        yield parts
        parts += max(1, parts // 10)
    yield most
