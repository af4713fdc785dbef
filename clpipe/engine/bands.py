"""Bands: launches that a CPU runs together, a few rows at a time. Pure.

A launch over a whole image stores it in memory, and the next launch loads it from there. In bands,
one kernel runs several launches. A work item computes a strip of columns from top to bottom. For
each band of :data:`BAND` rows of the result, each launch computes the rows that the next ones need.
They stay in the CPU's cache, in a ring: a buffer in which new rows replace those that no launch
needs any more.

Within a strip, no row is computed twice. At its sides, a launch also computes the columns that
later launches need, so neighbouring strips overlap. A strip is as wide as the cache allows.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache

from clpipe.engine.extents import Extent
from clpipe.engine.ir import AnyLaunch, Bands, Cpu, Image, Launch, reads_of
from clpipe.engine.sources import file_text
from clpipe.engine.work_items import columns_of, round_up

BAND = 8  # rows of the result; 4 and 16 are not faster
BLOCK = 4  # all leads are multiples of the highest block of a work item
SMALLEST = 2**15  # pixels of a strip, if the cache allows; the overlap of smaller ones costs more
# In bytes. Strips that fit into 256 KiB overlap so much that whole images were faster.
SMALLEST_CACHE = 2**20


@dataclass(frozen=True)
class Ring:
    """The stored rows of an image between two launches of a band.

    Attributes:
        image: the image.
        border: the width of its mirrored border in pixels, which its readers need.
        rows: the number of rows that are stored at a time, for each plane.
        offset: the rows of other rings before this one, in the buffer of a strip.
    """

    image: Image
    border: int
    rows: int
    offset: int


@dataclass(frozen=True)
class Schedule:
    """How the launches of a band follow each other.

    Attributes:
        leads: for each launch, how many rows it is ahead of the last launch.
        overlaps: for each launch, the columns that it computes on each side of a strip.
        rings: the ring of each image, by the image's number.
        rows: the rows of all rings together.
    """

    leads: tuple[int, ...]
    overlaps: tuple[int, ...]
    rings: dict[int, Ring]
    rows: int


@lru_cache(maxsize=256)
def schedule_of(bands: Bands) -> Schedule:
    """Return the schedule of the launches that run in bands."""
    parts = bands.parts
    leads, overlaps = [0] * len(parts), [0] * len(parts)
    rings: dict[int, Ring] = {}
    offset = 0
    for number in reversed(range(len(parts) - 1)):
        image = parts[number].writes
        assert image is not None
        readers = [
            (reader, parts[reader].radius)
            for reader in range(number + 1, len(parts))
            if any(read.image == image for read in parts[reader].reads)
        ]
        lead = leads[number] = max(leads[r] + round_up(radius, BLOCK) for r, radius in readers)
        overlaps[number] = max(overlaps[r] + radius for r, radius in readers)
        border = max(radius for _, radius in readers)
        # From the first row that a reader needs to the last mirror image of a row. A row within
        # `border` of the lower edge is mirrored before the edge itself is computed.
        rows = max(lead - leads[r] + radius for r, radius in readers) + BAND + 2 * border
        rings[image.number] = Ring(image, border, rows, offset)
        offset += rows * len(image.kind.channels)
    return Schedule(tuple(leads), tuple(overlaps), rings, offset)


def block_width(bands: Bands, lanes: int) -> int:
    """Return the columns of the widest block of a work item."""
    return lanes * max(columns_of(part, lanes) for part in bands.parts)


def margin_of(bands: Bands, lanes: int) -> int:
    """Return the columns that rings store on each side of a strip."""
    schedule, block = schedule_of(bands), block_width(bands, lanes)
    border = max(ring.border for ring in schedule.rings.values())
    return round_up(max(schedule.overlaps) + border, block) + block


def strip_of(bands: Bands, extent: Extent) -> tuple[int, int]:
    """Return the columns and rows of a strip; those at the right and lower edge are smaller."""
    return _strip_of(bands, extent.stored.width, extent.stored.height, extent.lanes)


@lru_cache(maxsize=1024)
def _strip_of(bands: Bands, width: int, height: int, lanes: int) -> tuple[int, int]:
    schedule, cores = schedule_of(bands), bands.cpu.cores
    step = 2 * block_width(bands, lanes)  # tiles begin at such columns as well
    budget = max(bands.cpu.cache, SMALLEST_CACHE)
    fitting = budget // (4 * schedule.rows) - 2 * margin_of(bands, lanes)
    fewest = -(-width // max(fitting // step * step, step))
    most = max(width * height // SMALLEST, 1)

    def cost(strip: tuple[int, int]) -> tuple[int, int]:
        columns, rows = strip
        count = -(-width // columns) * -(-height // rows)
        area = (columns + 2 * max(schedule.overlaps)) * (rows + 2 * max(schedule.leads))
        return -(-count // cores) * area, count

    sizes = (
        (round_up(-(-width // across), step), round_up(-(-height // down), BAND))
        for across in range(fewest, max(fewest, min(most, fewest + 2 * cores)) + 1)
        for down in range(1, max(1, min(most // across, 2 * cores)) + 1)
    )
    return min(sizes, key=cost)


def strips_of(bands: Bands, extent: Extent) -> tuple[int, int]:
    """Return the number of strips across and down."""
    columns, rows = strip_of(bands, extent)
    return -(-extent.stored.width // columns), -(-extent.stored.height // rows)


def ring_bytes(bands: Bands, extent: Extent) -> int:
    """Return the bytes of the rings of all strips."""
    columns, _ = strip_of(bands, extent)
    across, down = strips_of(bands, extent)
    pitch = columns + 2 * margin_of(bands, extent.lanes)
    return across * down * pitch * schedule_of(bands).rows * 4


def in_bands(launches: Sequence[AnyLaunch], results: set[int], cpu: Cpu) -> list[AnyLaunch]:
    """Return the launches of a plan, with those that can run in bands joined.

    Args:
        launches: the launches, in order.
        results: the numbers of images that must be stored whole, because they are results.
        cpu: the CPU.
    """
    joined: list[AnyLaunch] = []
    for run in runs_of(launches):
        rest = list(run)
        while rest:
            counts = range(len(rest), 0, -1)
            count = next(n for n in counts if n == 1 or is_closed(rest[:n], launches, results))
            parts = tuple(part for part in rest[:count] if isinstance(part, Launch))
            joined.append(rest[0] if count == 1 else join(Bands(parts, cpu)))
            del rest[:count]
    return joined


def runs_of(launches: Sequence[AnyLaunch]) -> Iterator[list[AnyLaunch]]:
    """Yield consecutive launches of which each can run in bands with the previous ones.

    A run ends with sums, because their result needs the whole image. A resampling needs it before
    it begins. A mosaic with a period needs another launch for its border.
    """
    run: list[AnyLaunch] = []
    for launch in launches:
        last = run[-1] if run else None
        if not (
            isinstance(last, Launch)
            and isinstance(launch, Launch)
            and launch.level == last.level
            and not (last.sums or last.has_period)
            and (launch.stencil or not launch.opener)
            and taps_agree([*run, launch])
        ):
            yield run
            run = []
        run.append(launch)
    yield run


def is_closed(run: Sequence[AnyLaunch], launches: Sequence[AnyLaunch], results: set[int]) -> bool:
    """Return whether only the launches of a run read what they write, apart from the last one."""
    inner = {part.writes.number for part in run[:-1] if isinstance(part, Launch) and part.writes}
    others = (launch for launch in launches if launch not in run)
    return not inner & (results | {r.image.number for other in others for r in reads_of(other)})


def taps_agree(launches: Sequence[AnyLaunch]) -> bool:
    """Return whether one kernel can contain these launches.

    The file of a stencil is compiled for the passes that are recomputed at its taps, and for the
    columns of its blocks. A kernel can contain the file only once.
    """
    compiled: dict[str, object] = {}
    for launch in launches:
        if isinstance(launch, Launch) and (stencil := launch.stencil):
            op, read = launch.ops[0], launch.src
            way = read.prologue if read and read.prologue else op.source, stencil.vectors_per_row
            files: set[str] = set()
            file_text(op.kernel, files)
            for file in files:
                if not file.startswith("lib/") and compiled.setdefault(file, way) != way:
                    return False
    return True


def join(bands: Bands) -> Launch:
    """Return the launch that runs bands."""
    first, last = bands.parts[0], bands.parts[-1]
    inner = {part.writes.number for part in bands.parts[:-1] if part.writes}
    reads = {r.image.number: r for part in bands.parts for r in part.reads}
    return replace(
        last,
        name=f"{first.name.split('..')[0]}..{last.name.split('..')[-1]}",
        ops=tuple(op for part in bands.parts for op in part.ops),
        reads=tuple(read for number, read in reads.items() if number not in inner),
        bands=bands,
    )
