"""The parts of a plan: images, the launches that read and write them, and the plan itself. Pure.

Images of one size form a level. The source is on level 0. Each resampling leads to the next level.
"""

from dataclasses import dataclass, replace
from functools import cached_property
from itertools import chain

from clpipe.base.cache import cached_hash
from clpipe.engine.bindings import Parameter
from clpipe.engine.ops import Op
from clpipe.reference.resample import Resampler, sizes
from clpipe.stage import Bands as SourceBands
from clpipe.stage import Kind, Pointwise, Resample, Stencil


@dataclass(frozen=True)
class Image:
    """An image between launches.

    ``period`` is the (rows, columns) of a mosaic's filter array, if a mirrored border would not
    continue this array; else None.
    """

    number: int
    kind: Kind
    level: int = 0
    period: tuple[int, int] | None = None


@dataclass(frozen=True)
class Read:
    """An image that a launch reads. The passes of ``prologue`` are recomputed at each tap."""

    image: Image
    prologue: tuple[Op, ...] = ()


@dataclass(frozen=True)
class Launch:
    """One kernel call over the image.

    Attributes:
        name: the name of the launch, for people.
        ops: the passes, in order.
        reads: the images of the stencil if the first pass is one, else the image to load or
            resample. It is empty if the launch reads the source.
        writes: the image to store.
        encodes: whether the launch writes eight-bit pixels.
        sums: the reduction of the result to sums.
        rows: the rows of a work item's block.
        columns: the vectors of a work item's block; with one lane, always one.
        level: the level of the result.
        bands: the launches that this one runs in bands, if any. ``ops`` and ``reads`` are all of
            theirs; the other attributes are those of the last.
    """

    name: str
    ops: tuple[Op, ...]
    reads: tuple[Read, ...] = ()
    writes: Image | None = None
    encodes: bool = False
    sums: Op | None = None
    rows: int = 2
    columns: int = 1
    level: int = 0
    bands: "Bands | None" = None

    @property
    def opener(self) -> Op | None:
        """The op that opens the group and reads images or bands itself, or None."""
        opens = self.ops and isinstance(self.ops[0].pass_.access, Stencil | Resample | SourceBands)
        return self.ops[0] if opens else None

    @property
    def has_period(self) -> bool:
        """Whether the launch writes a mosaic with a period, whose border it does not fill."""
        return self.writes is not None and self.writes.period is not None

    @property
    def radius(self) -> int:
        """The largest distance at which the launch reads stored images, in pixels."""
        return self.stencil.radius if self.stencil else 0

    @property
    def src(self) -> Read | None:
        """The read of the image that the opener calls ``src``, or None."""
        if not self.opener:
            return None
        return dict(zip(self.opener.pass_.reads, self.reads, strict=False)).get("src")

    @property
    def stencil(self) -> Stencil | None:
        """The access of the opener if it is a stencil, else None."""
        access = self.opener.pass_.access if self.opener else None
        return access if isinstance(access, Stencil) else None


@dataclass(frozen=True)
class Cpu:
    """The parts of a CPU that matter to a plan.

    Attributes:
        cores: the number of cores.
        cache: the bytes of the largest cache that each core has for itself.
    """

    cores: int
    cache: int


@cached_hash
@dataclass(frozen=True)
class Bands:
    """Launches that one kernel runs band by band on a CPU; see :mod:`clpipe.engine.bands`."""

    parts: tuple[Launch, ...]
    cpu: Cpu


@dataclass(frozen=True)
class Lines:
    """One launch that fills the line tables of all steps on a level."""

    ops: tuple[Op, ...]
    name: str = "lines"
    level: int = 0


@dataclass(frozen=True)
class Histogram:
    """The first part of a histogram: each work item counts pixels in some rows of an image."""

    op: Op
    reads: tuple[Read]
    name: str
    level: int = 0


@dataclass(frozen=True)
class Reduce:
    """The second part of a reduction: it adds block sums to partial sums, or adds up counts."""

    op: Op
    name: str
    level: int = 0


@dataclass(frozen=True)
class Finalize:
    """The end of a reduction: one work item computes estimates from the sums or the histogram."""

    op: Op
    name: str
    level: int = 0


@dataclass(frozen=True)
class Border:
    """One launch that fills the border of a plane, after stores that do not fill it.

    No plan contains it. Only images that are hardly wider than two borders need it, and mosaics
    with a ``period``.
    """

    slot: int
    level: int = 0
    period: tuple[int, int] | None = None
    name: str = "border"


AnyLaunch = Launch | Lines | Histogram | Reduce | Finalize


def unscaled(launch: AnyLaunch) -> AnyLaunch:
    """Return a launch without the scale of the resampling that opens it, if there is one."""
    if not isinstance(launch, Launch) or not launch.opener or not launch.reads or launch.stencil:
        return launch
    bands = launch.bands
    if bands:
        first = unscaled(bands.parts[0])
        assert isinstance(first, Launch)
        bands = replace(bands, parts=(first, *bands.parts[1:]))
    op = replace(launch.opener, pass_=replace(launch.opener.pass_, access=Pointwise()))
    return replace(launch, ops=(op, *launch.ops[1:]), bands=bands)


def reads_of(launch: AnyLaunch) -> tuple[Read, ...]:
    """Return the stored images that a launch reads."""
    return launch.reads if isinstance(launch, Launch | Histogram) else ()


@cached_hash
@dataclass(frozen=True)
class Plan:
    """The launches that develop one image, in order, and the slots of its planes.

    Attributes:
        source: the kind of the source.
        half: whether the source is float16, not float32.
        planar: whether the source is stored as consecutive planes, not interleaved.
        bands: the bands of a spectral source; 0 for another source.
        launches: the launches, in order.
        slots: the slots of each image's planes, by the image's number.
        slot_count: the number of slots.
        kept: each step to keep, with its image.
        final: the last image as float planes, if requested.
        encoded: the kind of the eight-bit pixels, if requested.
        border: the width of the planes' borders in pixels.
        states: each step with state, with its results for the frame before and for this frame. None
            stands for the former in a plan of a first frame.
        resamplings: the resampling from each level to the next.
    """

    source: Kind
    half: bool
    planar: bool
    launches: tuple[AnyLaunch, ...]
    slots: tuple[tuple[int, ...], ...]
    slot_count: int = 0
    kept: tuple[tuple[str, Image], ...] = ()
    final: Image | None = None
    encoded: Kind | None = None
    border: int = 0
    states: tuple[tuple[str, Image | None, Image], ...] = ()
    resamplings: tuple[Resampler, ...] = ()
    bands: int = 0

    @property
    def source_bytes(self) -> int:
        """The bytes of a pixel of the source."""
        return (self.bands or len(self.source.channels)) * (2 if self.half else 4)

    @cached_property
    def unscaled(self) -> "Plan":
        """The plan without the scales of its resamplings. Kernels do not depend on the scales."""
        if not self.resamplings:
            return self
        launches = tuple(unscaled(launch) for launch in self.launches)
        return replace(self, launches=launches, resamplings=())

    @cached_property
    def alone(self) -> tuple[AnyLaunch, ...]:
        """The launches, with those that run in bands as separate launches."""
        parts = (
            x.bands.parts if isinstance(x, Launch) and x.bands else (x,) for x in self.launches
        )
        return tuple(chain.from_iterable(parts))

    @cached_property
    def estimates(self) -> dict[str, tuple[str, ...]]:
        """The names of the numbers that each step estimates from the image."""
        found = [launch.op for launch in self.launches if isinstance(launch, Finalize)]
        return {op.step: op.reduction.estimates for op in found}

    def sizes(self, width: int, height: int) -> tuple[tuple[int, int], ...]:
        """Return the width and height of each level's images, from those of the source."""
        return sizes(self.resamplings, width, height)

    def is_tiny(self, width: int, height: int) -> bool:
        """Return whether some image is so small that a pixel has several mirror images.

        Launches that read such an image cannot run in bands.
        """
        return min(map(min, self.sizes(width, height))) <= 2 * self.border + 1

    def check_resamplings(self, width: int, height: int) -> None:
        """Check that an image of this size can be resampled.

        Raises:
            ImageError: it cannot be resampled, for example because a lens would fold it over.
        """
        for resampling, size in zip(self.resamplings, self.sizes(width, height), strict=False):
            resampling.values(*size)

    def level_of(self, number: int) -> int:
        """Return the level of a result image, by its number."""
        results = [image for _, image in self.kept] + ([self.final] if self.final else [])
        return next(image.level for image in results if image.number == number)

    @cached_property
    def levels_of_slots(self) -> tuple[frozenset[int], ...]:
        """For each slot, the levels of the images whose planes occupy it."""
        images = [x.writes for x in self.launches if isinstance(x, Launch) and x.writes]
        images += [previous for _, previous, _ in self.states if previous]
        return tuple(
            frozenset(image.level for image in images if slot in self.slots[image.number])
            for slot in range(self.slot_count)
        )


@dataclass(frozen=True)
class Kernel:
    """The OpenCL kernel of a launch: its name, complete source and parameters in order.

    ``files`` are the kernel files that the source includes.
    """

    name: str
    source: str
    parameters: tuple[Parameter, ...]
    launch: AnyLaunch | Border
    files: tuple[str, ...]
