"""From a chain of stages to launches and buffer slots. Pure: it needs no device.

Passes go into groups, and a group becomes one launch. A stencil opens a group, because the pixels
around it must be stored first; pointwise passes join the group before them; sums and a kept image
close it. Launches pass images of one to three planes to each other. A plane occupies a slot, a
buffer on the device, from the launch that writes it to the last one that reads it.

Images of one size are a level. The source is on level 0; each resampling leads to the next.
"""

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from functools import cached_property

from clpipe.chain.chain import Chain
from clpipe.engine.ops import Op, chain_ops
from clpipe.reference.resample import Resampler, sizes
from clpipe.stage import Access, Kind

# Borders are multiples of it where images are held, so that planes lie alike in plans whose widest
# stencils differ a little. A default chain's is 4; with 8 it takes 5 % longer (PoCL, two cores).
HELD_BORDER = 4


@dataclass(frozen=True)
class Image:
    """An image between launches."""

    number: int
    kind: Kind
    level: int = 0


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
    stored, ``encodes`` whether eight-bit pixels are written, ``sums`` a SUMS pass over the result.
    ``level`` is that of the result.
    """

    name: str
    ops: tuple[Op, ...]
    reads: tuple[Read, ...] = ()
    writes: Image | None = None
    encodes: bool = False
    sums: Op | None = None
    rows: int = 2  # of a work item's block
    columns: int = 1  # of it, in vectors
    level: int = 0

    @property
    def opener(self) -> Op | None:
        """The op that opens the group and reads images by itself, if one does."""
        opens = self.ops and self.ops[0].pass_.access in (Access.STENCIL, Access.RESAMPLE)
        return self.ops[0] if opens else None

    @property
    def stencil(self) -> Op | None:
        """The opener, if it is a stencil."""
        op = self.opener
        return op if op and op.pass_.access is Access.STENCIL else None


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


AnyLaunch = Launch | Lines | Histogram | Reduce | Finalize


def unscaled(launch: AnyLaunch) -> AnyLaunch:
    """A launch without the scale of the resampling that opens it, if one does."""
    if not isinstance(launch, Launch) or not launch.opener:
        return launch
    op = replace(launch.opener, pass_=replace(launch.opener.pass_, resampling=None))
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
    hold: bool = False  # whether all images stay, so that launches can be left out
    resamplings: tuple[Resampler, ...] = ()  # from each level to the next

    def __hash__(self) -> int:
        return self._hash

    @cached_property
    def _hash(self) -> int:
        # A plan is looked up for each image, and hashing all that is in it takes a while.
        return hash(tuple(getattr(self, each.name) for each in fields(self)))

    @cached_property
    def unscaled(self) -> "Plan":
        """What plans have in common that differ in the scales of resamplings alone: the kernels."""
        if not self.resamplings:
            return self
        launches = tuple(unscaled(launch) for launch in self.launches)
        return replace(self, launches=launches, resamplings=())

    def sizes(self, width: int, height: int) -> tuple[tuple[int, int], ...]:
        """The width and height of images on each level, from those of the source."""
        return sizes(self.resamplings, width, height)

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


class _Planner:
    def __init__(self, source: Kind, fold: bool) -> None:
        self.kind = source
        self.fold = fold
        self.launches: list[AnyLaunch] = []
        self.lines: dict[int, list[Op]] = {}  # by level
        self.resamplings: list[Resampler] = []
        self.images: list[Image] = []
        self.group: Launch | None = Launch("load", ())  # open, still to be stored
        self.stored: Image | None = None  # the current image, when no group is open
        # Where the current image was kept, how a stencil reads it all the same; and the image that
        # only keeping has stored, in the midst of a group.
        self.folded: Read | None = None
        self.split: Image | None = None

    @property
    def level(self) -> int:
        return len(self.resamplings)

    def new_image(self) -> Image:
        image = Image(len(self.images), self.kind, self.level)
        self.images.append(image)
        return image

    def close(self, sums: Op | None = None) -> Image:
        """End the open group and store its result. Without an open group the image is stored."""
        if self.group is None:
            assert self.stored is not None
            if not sums:
                return self.stored
            self.group = Launch("sums", (), (Read(self.stored),))
        elif sums and self.group.stencil and self.group.stencil.pass_.block:
            # Sums go over narrower blocks.
            self.group = Launch("sums", (), (Read(self.close()),))
        if sums and not self.group.ops and self.group.reads:
            image = self.group.reads[0].image  # nothing new to store
            self.emit(replace(self.group, sums=sums))
        else:
            image = self.new_image()
            self.emit(replace(self.group, writes=image, sums=sums))
        self.group, self.stored = None, image
        return image

    def emit(self, group: Launch) -> None:
        names = list(dict.fromkeys(op.step for op in group.ops))
        block = group.stencil.pass_.block if group.stencil else 0
        shared = block or group.sums or any(op.pass_.random for op in group.ops)
        name = names[0] if len(names) == 1 else f"{names[0]}..{names[-1]}" if names else group.name
        if (op := group.opener) and op.pass_.function != op.step:
            name = name.replace(op.step, f"{op.step}.{op.pass_.function}", 1)
        self.launches.append(
            replace(
                group,
                name=name,
                rows=4 if shared else 2,
                columns=max(block, 1),
                level=self.level,
            )
        )

    def keep(self) -> Image:
        """Store the current image because it is wanted.

        Stencils after it read what they would read otherwise, so they are the same kernels.
        """
        folded, is_open = self.foldable(), self.group is not None
        image = self.close()
        self.folded = folded
        if is_open and not folded:
            self.split = image
        return image

    def foldable(self) -> Read | None:
        """The current image as cheap pointwise passes on a stored one, if it is that."""
        group = self.group
        if not (self.fold and group and group.reads) or group.opener:
            return self.folded
        cheap = all(op.pass_.cheap for op in group.ops)
        read = Read(group.reads[0].image, group.ops)
        return read if cheap and read.image is not self.split else None

    def input_of_stencil(self) -> Read:
        """The current image for a stencil: cheap pointwise passes on a stored one are redone."""
        read = self.foldable()
        if read is None:
            return Read(self.close())
        if self.group:
            self.group, self.stored = None, read.image
        return read

    def add_step(self, ops: Sequence[Op]) -> None:
        local: dict[str, Read] = {}
        if any(op.pass_.access is Access.STENCIL and "src" in op.pass_.reads for op in ops):
            local["src"] = self.input_of_stencil()
        written = "src"
        for op in ops:
            pass_ = op.pass_
            match pass_.access:
                case Access.LINES:
                    self.lines.setdefault(self.level, []).append(op)
                    continue
                case Access.SUMS:
                    self.close(sums=op)
                    self.split = None
                    self.launches.append(Reduce(op, f"{op.step}.add_up", self.level))
                    self.launches.append(Finalize(op, f"{op.step}.{pass_.finish}", self.level))
                    continue
                case Access.HISTOGRAM:
                    stored = Read(self.close())
                    self.split = None
                    count = Histogram(op, (stored,), f"{op.step}.count", self.level)
                    self.launches.append(count)
                    self.launches.append(Reduce(op, f"{op.step}.add_up", self.level))
                    self.launches.append(Finalize(op, f"{op.step}.{pass_.finish}", self.level))
                    continue
                case Access.STENCIL:
                    if written not in local:
                        local[written] = Read(self.close())
                    self.group = Launch("", (op,), tuple(local[name] for name in pass_.reads))
                case Access.RESAMPLE:
                    assert pass_.resampling
                    self.group = Launch("", (op,), (Read(self.close()),))
                    self.resamplings.append(pass_.resampling)
                case Access.POINTWISE | Access.CURVE:
                    if self.group is None:
                        assert self.stored is not None
                        self.group = Launch("", (), (Read(self.stored),))
                    # Where the pass that it undoes was stored, it is done all the same.
                    undone = op.undoes and self.group.ops
                    ops_ = self.group.ops[:-1] if undone else (*self.group.ops, op)
                    self.group = replace(self.group, ops=ops_)
            self.folded = None
            self.kind, written = op.kind, pass_.writes


def make_plan(
    chain: Chain,
    half: bool = True,
    keep: Sequence[str] = (),
    encode: bool = True,
    final: bool = False,
    fold: bool = True,
    planar: bool = False,
    hold: bool = False,
) -> Plan:
    """The plan of a chain.

    Args:
        half: whether the source holds half floats, not floats.
        keep: steps whose image is returned.
        encode: whether the last image is returned in eight bits.
        final: whether the last image is returned in float. Without either, the plan ends with the
            last step to keep.
        fold: whether a stencil redoes cheap passes at its taps. It must not for images one pixel
            wide or high, where mirroring changes the Bayer phase.
        planar: whether the source is planes one behind the other, not interleaved.
        hold: whether each image has slots of its own, so that a launch whose results are on the
            device already can be left out.

    Raises:
        RequestError: the chain has no such step to keep.
    """
    for name in keep:
        chain.step_named(name)
    if not (encode or final):
        chain = chain.through(keep)
    last = chain.steps[-1].name
    final = final or last in keep
    planner = _Planner(chain.source, fold)
    kept: dict[str, Image] = {}
    arguments = {step.name: step.method.arguments(step.context) for step in chain.steps}
    for name, ops in chain_ops(chain, arguments):
        planner.add_step(ops)
        if name in keep and name != last:
            kept[name] = planner.keep()
    group = planner.group or Launch("encode", (), (Read(planner.close()),))
    final_image = None
    if final:
        final_image = planner.new_image()
        if last in keep:
            kept[last] = final_image
    planner.emit(replace(group, writes=final_image, encodes=encode))
    launches = list(planner.launches)
    launches[:0] = [Lines(tuple(ops), level=level) for level, ops in planner.lines.items()]
    results = [*kept.values(), final_image] if final_image else kept.values()
    pinned = {image.number for image in (planner.images if hold else results)}
    slots, count = assign_slots(launches, planner.images, pinned)
    radii = [x.opener.pass_.radius for x in launches if isinstance(x, Launch) and x.opener]
    border = max(radii, default=0)
    return Plan(
        source=chain.source,
        half=half,
        planar=planar,
        launches=tuple(launches),
        slots=slots,
        slot_count=count,
        kept=tuple(kept.items()),
        final=final_image,
        encoded=chain.result if encode else None,
        border=-(-border // HELD_BORDER) * HELD_BORDER if hold else border,
        hold=hold,
        resamplings=tuple(planner.resamplings),
    )


def assign_slots(
    launches: Sequence[AnyLaunch], images: Sequence[Image], pinned: set[int]
) -> tuple[tuple[tuple[int, ...], ...], int]:
    """Slots for the planes of every image, by liveness.

    Args:
        launches: in order.
        images: that they write.
        pinned: numbers of images whose slots are never reused, since they are results or held.

    Returns:
        The slots of each image, by its number, and how many slots there are.
    """
    last_use = {
        read.image.number: i for i, launch in enumerate(launches) for read in reads_of(launch)
    }
    slots: dict[int, tuple[int, ...]] = {}
    free: list[int] = []
    count = 0
    for i, launch in enumerate(launches):
        if isinstance(launch, Launch) and launch.writes:
            planes = len(launch.writes.kind.channels)
            while len(free) < planes:
                free.append(count)
                count += 1
            slots[launch.writes.number] = tuple(free[:planes])
            del free[:planes]
        for read in {read.image.number for read in reads_of(launch)}:
            if last_use[read] == i and read not in pinned:
                free.extend(slots[read])
    return tuple(slots[image.number] for image in images), count
