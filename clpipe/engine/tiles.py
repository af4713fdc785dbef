"""An image on a device, whole or in tiles: where its planes begin, and what memory they take. Pure.

A tile is a core, the part of the result that it makes, with a halo around it for stencils to read.
Cores begin with whole blocks of lanes and of four rows, so a pixel has the same place in its work
item as in the whole image: its noise, its CFA phase and its arithmetic are the same, bit for bit.
"""

import math
from bisect import bisect_left
from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache

import numpy as np

from clpipe.base.errors import ImageError
from clpipe.base.memory import in_words
from clpipe.engine.codegen import PARTIALS, border_left, round_up
from clpipe.engine.plan import (
    AnyLaunch,
    Finalize,
    Histogram,
    Launch,
    Lines,
    Op,
    Plan,
    Reduce,
    reads_of,
)

# Larger ones are no faster, and memory that is new to a process costs time: 600 megapixels took
# 28 s in tiles of 1 GiB and 39 s in tiles of 4 GiB (PoCL, two busy cores).
LARGEST_TILE = 2**30  # bytes


@dataclass(frozen=True)
class Box:
    """A part of an image: the columns from ``left`` to before ``right``, and rows likewise."""

    left: int
    top: int
    right: int
    bottom: int

    @property
    def width(self) -> int:
        """How many columns."""
        return self.right - self.left

    @property
    def height(self) -> int:
        """How many rows."""
        return self.bottom - self.top


@dataclass(frozen=True)
class Extent:
    """An image, or a tile of it with its halo, and the size of its planes on a device."""

    width: int  # of the image
    height: int
    lanes: int
    border: int
    core: Box
    stored: Box  # core and halo

    @classmethod
    def whole(cls, width: int, height: int, lanes: int, border: int) -> "Extent":
        """An image in one piece."""
        box = Box(0, 0, width, height)
        return cls(width, height, lanes, border, box, box)

    @cached_property
    def pitch(self) -> int:
        """Floats from one row of a plane to the next."""
        pitch = self.padded_width + 2 * border_left(self.border, self.lanes)
        # Rows a multiple of 4 KiB apart would fall into the same cache sets.
        return pitch + self.lanes * (pitch % 1024 == 0)

    @property
    def padded_width(self) -> int:
        """The width of the planes, in whole blocks."""
        return round_up(self.stored.width, self.lanes)

    @property
    def padded_height(self) -> int:
        """The height of the planes, in whole blocks of four rows."""
        return round_up(self.stored.height, 4)

    @property
    def blocks(self) -> int:
        """The number of blocks of lanes and four rows, each of which has sums of its own."""
        return self.padded_width // self.lanes * (self.padded_height // 4)

    @property
    def plane_bytes(self) -> int:
        """The bytes of a plane with its border, and a margin that the last block's loads need."""
        return ((self.padded_height + 2 * self.border) * self.pitch + 5 * self.lanes) * 4

    @cached_property
    def numbers(self) -> dict[str, np.uint32]:
        """The values of the kernel parameters that describe it, by name."""
        core = {f"core_{side}": value for side, value in vars(self.core).items()}
        numbers = {
            "width": self.width,
            "height": self.height,
            "pitch": self.pitch,
            "left": self.stored.left // self.lanes,
            "top": self.stored.top // 4,
            "columns": self.stored.width,
            "rows": self.stored.height,
            "border": self.border,
            "blocks": self.blocks,
            **core,
        }
        return {name: np.uint32(value) for name, value in numbers.items()}


def buffer_sizes(plan: Plan, extent: Extent) -> dict[str, int]:
    """The device buffers that a plan needs for an image or a tile: bytes by name."""
    pixels = extent.padded_height * extent.stored.width
    source = pixels * len(plan.source.channels) + 3 * extent.lanes
    sizes = {"src": source * (2 if plan.half else 4)}
    sizes |= {f"slot{number}": extent.plane_bytes for number in range(plan.slot_count)}
    if plan.encoded:
        sizes["dst"] = extent.stored.width * extent.stored.height * len(plan.encoded.channels)
    # Line tables are the image's: whole blocks of rows, and the last vector.
    longest = round_up(max(extent.width, extent.height), max(extent.lanes, 4)) + 2 * extent.lanes
    for launch in plan.launches:
        match launch:
            case Lines(ops=ops):
                sizes |= {f"lines.{op.step}": longest * 4 for op in ops}
            case Launch(sums=sums) if sums:
                sizes |= {"sums": extent.blocks * 16, "partials": PARTIALS * 32}
            case Histogram(op=op):
                bins = op.pass_.bins
                sizes["counts"] = max(sizes.get("counts", 0), PARTIALS * bins * 4)
                sizes["histogram"] = max(sizes.get("histogram", 0), bins * 4)
            case Finalize(op=op):
                sizes[f"estimates.{op.step}"] = 16
    return sizes


@dataclass(frozen=True)
class Phase:
    """Launches, by their numbers: once at first, for each tile, once at the end."""

    first: tuple[int, ...]
    each: tuple[int, ...]
    last: tuple[int, ...]


@dataclass(frozen=True)
class Tiling:
    """How an image goes through a plan: its tiles, in which phases, and the bytes it takes."""

    tiles: tuple[Extent, ...]
    phases: tuple[Phase, ...]
    sizes: dict[str, int]

    @property
    def bytes(self) -> int:
        """Device memory of all buffers."""
        return sum(self.sizes.values())


def phases_of(plan: Plan) -> tuple[Phase, ...]:
    """The phases in which tiles go through a plan, one for each pass over all tiles.

    A number that is estimated from the whole image ends a phase: each phase but the last goes, over
    all tiles, as far as one reduction, and the next begins again at the source.
    """
    numbered = tuple(enumerate(plan.launches))
    lines = tuple(i for i, launch in numbered if isinstance(launch, Lines))
    phases = []
    for end, find in numbered:
        if isinstance(find, Finalize):
            reduces = {i for i, launch in numbered if reduction_of(launch) is find.op}
            phases.append(Phase((), leading_to(plan, reduces), (end,)))
    results = {image.number for _, image in plan.kept}
    results |= {plan.final.number} if plan.final else set()
    ends = {
        i
        for i, launch in numbered
        if isinstance(launch, Launch)
        and (launch.encodes or (launch.writes and launch.writes.number in results))
    }
    phases.append(Phase((), leading_to(plan, ends), ()))
    return (replace(phases[0], first=lines), *phases[1:])


def reduction_of(launch: AnyLaunch) -> Op | None:
    """The reduction that a launch is a part of, but for the reduction's end."""
    if isinstance(launch, Launch):
        return launch.sums
    return launch.op if isinstance(launch, Histogram | Reduce) else None


def leading_to(plan: Plan, ends: set[int]) -> tuple[int, ...]:
    """These launches, and all that they depend on."""
    images: set[int] = set()
    chosen = []
    for number, launch in reversed(tuple(enumerate(plan.launches))):
        writes = launch.writes if isinstance(launch, Launch) else None
        if number in ends or (writes and writes.number in images):
            chosen.append(number)
            images |= {read.image.number for read in reads_of(launch)}
    return tuple(reversed(chosen))


def halo_of(plan: Plan) -> int:
    """How many pixels around each the source is read, through all stencils in a row."""
    reach: dict[int, int] = {}  # around each image that is stored
    source = 0
    for launch in reversed(plan.launches):
        if isinstance(launch, Launch):
            own = reach.get(launch.writes.number, 0) if launch.writes else 0
            own += launch.stencil.pass_.radius if launch.stencil else 0
            source = source if launch.reads else max(source, own)
        else:
            own = 0
        for read in reads_of(launch):
            reach[read.image.number] = max(reach.get(read.image.number, 0), own)
    return source


@lru_cache(maxsize=64)
def tiling_of(plan: Plan, width: int, height: int, lanes: int, memory: int, largest: int) -> Tiling:
    """How an image goes through a plan in limited memory: whole if it fits, else in tiles.

    Of the divisions that fit, the one with the smallest share of halos is chosen. Among those that
    differ by less than 2 %, it is the one into the fewest columns, since full rows are transferred
    in one piece.

    Args:
        width: of the image, and its height, in pixels.
        lanes: of the device.
        memory: bytes that all buffers together may take.
        largest: bytes that a single buffer may take.

    Raises:
        ImageError: not even the smallest tile fits; the message says what it needs.
    """
    whole = Extent.whole(width, height, lanes, plan.border)

    def fits(extent: Extent, memory: int) -> bool:
        sizes = buffer_sizes(plan, extent).values()
        return sum(sizes) <= memory and max(sizes) <= largest

    if fits(whole, memory):
        every = tuple(range(len(plan.launches)))
        return Tiling((whole,), (Phase((), every, ()),), buffer_sizes(plan, whole))
    across = lanes * math.lcm(2, *(x.columns for x in plan.launches if isinstance(x, Launch)))
    halo = halo_of(plan)
    of_tile = min(memory, LARGEST_TILE)

    def tile(left: int, top: int, columns: int, rows: int) -> Extent:
        core = Box(left, top, min(left + columns, width), min(top + rows, height))
        stored = Box(
            max(left - round_up(halo, across), 0),
            max(top - round_up(halo, 4), 0),
            min(core.right + halo, width),
            min(core.bottom + halo, height),
        )
        return replace(whole, core=core, stored=stored)

    def amid(columns: int, rows: int) -> Extent:
        """A tile of that size with the most halo that one can have."""
        wide, high = columns + round_up(halo, across) + halo, rows + round_up(halo, 4) + halo
        box = Box(0, 0, min(wide, round_up(width, across)), min(high, round_up(height, 4)))
        return replace(whole, core=box, stored=box)

    best: tuple[float, int, int] | None = None
    for columns in dict.fromkeys(
        round_up(-(-width // parts), across) for parts in divisions(-(-width // across))
    ):
        blocks = bisect_left(
            range(1, -(-height // 4) + 1),
            True,
            key=lambda n: not fits(amid(columns, 4 * n), of_tile),
        )
        if blocks:
            parts = -(-height // (4 * blocks))
            rows = round_up(-(-height // parts), 4)
            extent = amid(columns, rows).stored
            cost = extent.width * extent.height / (columns * rows)
            if best is None or cost < best[0] / 1.02:
                best = cost, columns, rows
    if best is None:
        least = amid(across, 4)
        needs = buffer_sizes(plan, least)
        raise ImageError(
            f"{width}x{height} pixels need {in_words(sum(buffer_sizes(plan, whole).values()))} of "
            f"device memory, or in the smallest tiles {in_words(sum(needs.values()))}, with "
            f"{in_words(max(needs.values()))} in one piece; allowed are {in_words(memory)}, with "
            f"{in_words(largest)} in one piece"
        )
    _, columns, rows = best
    tiles = tuple(
        tile(left, top, columns, rows)
        for top in range(0, height, rows)
        for left in range(0, width, columns)
    )
    return Tiling(tiles, phases_of(plan), buffer_sizes(plan, amid(columns, rows)))


def divisions(most: int) -> Iterator[int]:
    """Numbers of tiles to try: all small ones, then in steps of about a tenth.

    >>> list(divisions(12))
    [1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 12]
    """
    parts = 1
    while parts < most:
        yield parts
        parts += max(1, parts // 10)
    yield most
