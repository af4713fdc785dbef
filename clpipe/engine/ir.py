"""The parts of a plan: images, the launches that read and write them, and the plan itself. Pure.

Images of one size are a level. The source is on level 0; each resampling leads to the next.
"""

from dataclasses import dataclass, fields, replace
from functools import cached_property

from clpipe.engine.bindings import Parameter
from clpipe.engine.ops import Op
from clpipe.reference.resample import Resampler, sizes
from clpipe.stage import Kind, Pointwise, Resample, Stencil


@dataclass(frozen=True)
class Image:
    """An image between launches.

    ``period`` is that of a mosaic whose array a mirrored border would not go on with: its rows and
    columns.
    """

    number: int
    kind: Kind
    level: int = 0
    period: tuple[int, int] | None = None


@dataclass(frozen=True)
class Read:
    """An image as a launch reads it: the passes of ``prologue`` are redone at each tap."""

    image: Image
    prologue: tuple[Op, ...] = ()


@dataclass(frozen=True)
class Launch:
    """One kernel call over the image.

    ``reads`` has the images of the stencil if the first op is one, else the one image that is
    loaded or resampled; it is empty if the launch reads the source. ``writes`` is the image that is
    stored, ``encodes`` whether eight-bit pixels are written, ``sums`` a reduction of the result to
    sums. ``level`` is that of the result.
    """

    name: str
    ops: tuple[Op, ...]
    reads: tuple[Read, ...] = ()
    writes: Image | None = None
    encodes: bool = False
    sums: Op | None = None
    rows: int = 2  # of a work item's block
    columns: int = 1  # of it, in vectors; on one lane it is one
    level: int = 0

    @property
    def opener(self) -> Op | None:
        """The op that opens the group and reads images by itself, if one does."""
        opens = self.ops and isinstance(self.ops[0].pass_.access, Stencil | Resample)
        return self.ops[0] if opens else None

    @property
    def has_period(self) -> bool:
        """Whether it writes a mosaic with a period, whose border it does not fill."""
        return self.writes is not None and self.writes.period is not None

    @property
    def stencil(self) -> Stencil | None:
        """The access of the opener, if it is a stencil."""
        access = self.opener.pass_.access if self.opener else None
        return access if isinstance(access, Stencil) else None


@dataclass(frozen=True)
class Lines:
    """One launch that fills the line tables of all steps on a level that have one."""

    ops: tuple[Op, ...]
    name: str = "lines"
    level: int = 0


@dataclass(frozen=True)
class Histogram:
    """The first part of a histogram: each work item counts some of a stored image's rows."""

    op: Op
    reads: tuple[Read]
    name: str
    level: int = 0


@dataclass(frozen=True)
class Reduce:
    """The second part of a reduction: block sums to partial sums, or counts to one histogram."""

    op: Op
    name: str
    level: int = 0


@dataclass(frozen=True)
class Finalize:
    """The end of a reduction: one work item makes estimates from the sums or the histogram."""

    op: Op
    name: str
    level: int = 0


@dataclass(frozen=True)
class Border:
    """One launch that fills the border of a plane, after stores that do not fill it.

    It is in no plan: only images that are hardly wider than two borders need it, and mosaics with a
    ``period``.
    """

    slot: int
    level: int = 0
    period: tuple[int, int] | None = None
    name: str = "border"


AnyLaunch = Launch | Lines | Histogram | Reduce | Finalize


def unscaled(launch: AnyLaunch) -> AnyLaunch:
    """A launch without the scale of the resampling that opens it, if one does."""
    if not isinstance(launch, Launch) or not launch.opener or launch.stencil:
        return launch
    op = replace(launch.opener, pass_=replace(launch.opener.pass_, access=Pointwise()))
    return replace(launch, ops=(op, *launch.ops[1:]))


def reads_of(launch: AnyLaunch) -> tuple[Read, ...]:
    """The stored images that a launch reads."""
    return launch.reads if isinstance(launch, Launch | Histogram) else ()


@dataclass(frozen=True)
class Plan:
    """The launches that develop one image, in order, and the slots of its planes."""

    source: Kind
    half: bool
    planar: bool  # whether the source is planes one behind the other, not interleaved
    launches: tuple[AnyLaunch, ...]
    slots: tuple[tuple[int, ...], ...]  # of the planes of each image, by its number
    slot_count: int = 0
    kept: tuple[tuple[str, Image], ...] = ()  # step -> its image
    final: Image | None = None  # the last image as float planes
    encoded: Kind | None = None  # the kind that is encoded to eight bits
    border: int = 0
    incremental: bool = False  # whether all images stay, so that launches can be left out
    resamplings: tuple[Resampler, ...] = ()  # from each level to the next

    def __hash__(self) -> int:
        return self._hash

    @cached_property
    def _hash(self) -> int:
        # A plan is looked up for each image, and hashing all that is in it takes a while.
        return hash(tuple(getattr(self, each.name) for each in fields(self)))

    @cached_property
    def unscaled(self) -> "Plan":
        """The plan without the scales of resamplings, on which its kernels do not depend."""
        if not self.resamplings:
            return self
        launches = tuple(unscaled(launch) for launch in self.launches)
        return replace(self, launches=launches, resamplings=())

    @cached_property
    def estimates(self) -> dict[str, tuple[str, ...]]:
        """The names of the numbers that steps estimate from the image, by step."""
        found = [launch.op for launch in self.launches if isinstance(launch, Finalize)]
        return {op.step: op.reduction.estimates for op in found}

    def sizes(self, width: int, height: int) -> tuple[tuple[int, int], ...]:
        """The width and height of images on each level, from those of the source."""
        return sizes(self.resamplings, width, height)

    def check_resamplings(self, width: int, height: int) -> None:
        """Check that an image of that size can be resampled.

        Raises:
            ImageError: it cannot, for example because a lens would fold it over.
        """
        for resampling, size in zip(self.resamplings, self.sizes(width, height), strict=False):
            resampling.values(*size)

    def level_of(self, number: int) -> int:
        """The level of an image that is a result, by its number."""
        results = [image for _, image in self.kept] + ([self.final] if self.final else [])
        return next(image.level for image in results if image.number == number)

    @cached_property
    def levels_of_slots(self) -> tuple[frozenset[int], ...]:
        """For each slot, the levels of the images whose planes occupy it."""
        images = [x.writes for x in self.launches if isinstance(x, Launch) and x.writes]
        return tuple(
            frozenset(image.level for image in images if slot in self.slots[image.number])
            for slot in range(self.slot_count)
        )


@dataclass(frozen=True)
class Kernel:
    """A launch as OpenCL: the kernel's name, its whole source and its parameters in order.

    ``files`` are the kernel files that the source includes.
    """

    name: str
    source: str
    parameters: tuple[Parameter, ...]
    launch: AnyLaunch | Border
    files: tuple[str, ...]
