"""Makes the plan of a chain: its launches. Pure: it needs no device.

Passes form groups, and each group becomes one launch. A stencil opens a group, because the pixels
around it must be stored first. Pointwise passes join the open group. Sums and a kept image close
it. Launches exchange images of one to three planes. A plane occupies a slot, which is a buffer on
the device, from the launch that writes it to the last launch that reads it.
"""

from collections.abc import Sequence
from dataclasses import replace

from clpipe.chain.chain import Chain
from clpipe.engine.bands import in_bands
from clpipe.engine.ir import (
    AnyLaunch,
    Cpu,
    Finalize,
    Histogram,
    Image,
    Launch,
    Lines,
    Plan,
    Read,
    Reduce,
)
from clpipe.engine.ops import FrameKind, Op, border_periods, chain_ops
from clpipe.engine.slots import assign_slots
from clpipe.reference.resample import Resampler
from clpipe.stage import (
    PREVIOUS,
    Bands,
    Kind,
    LineTable,
    Pointwise,
    Reduction,
    Resample,
    Stencil,
    TableLookup,
)


class _Planner:
    def __init__(self, source: Kind, fold: bool) -> None:
        self.kind = source
        self.period: tuple[int, int] | None = None  # period of the mosaic that the next step reads
        self.fold = fold
        self.launches: list[AnyLaunch] = []
        self.lines: dict[int, list[Op]] = {}  # by level
        self.resamplings: list[Resampler] = []
        self.images: list[Image] = []
        self.previous: dict[str, Image] = {}  # results for the frame before, by step
        self.group: Launch | None = Launch("load", ())  # the open group, not yet stored
        self.stored: Image | None = None  # the current image, if no group is open
        # If the current image is kept: the read with which a stencil can still fold it. And the
        # image that was stored in the middle of a group, only because it is kept.
        self.folded: Read | None = None
        self.split: Image | None = None

    @property
    def level(self) -> int:
        return len(self.resamplings)

    def new_image(self) -> Image:
        period = self.period if self.kind in (Kind.MOSAIC, Kind.RAW) else None
        image = Image(len(self.images), self.kind, self.level, period)
        self.images.append(image)
        return image

    def close(self, sums: Op | None = None) -> Image:
        """Close the open group and store its result, unless the image is stored already."""
        if self.group is None:
            assert self.stored is not None
            if not sums:
                return self.stored
            self.group = Launch("sums", (), (Read(self.stored),))
        elif sums and self.group.stencil and self.group.stencil.vectors_per_row:
            # Sums need narrower blocks.
            self.group = Launch("sums", (), (Read(self.close()),))
        if sums and not self.group.ops and self.group.reads:
            image = self.group.reads[0].image  # it is stored already
            self.emit(replace(self.group, sums=sums))
        else:
            image = self.new_image()
            self.emit(replace(self.group, writes=image, sums=sums))
        self.group, self.stored = None, image
        return image

    def emit(self, group: Launch) -> None:
        names = list(dict.fromkeys(op.step for op in group.ops))
        vectors = group.stencil.vectors_per_row if group.stencil else 0
        shared = vectors or group.sums or any(op.pass_.random for op in group.ops)
        name = names[0] if len(names) == 1 else f"{names[0]}..{names[-1]}" if names else group.name
        if (op := group.opener) and op.pass_.function != op.step:
            name = name.replace(op.step, f"{op.step}.{op.pass_.function}", 1)
        self.launches.append(
            replace(
                group,
                name=name,
                rows=4 if shared else 2,
                columns=max(vectors, 1),
                level=self.level,
            )
        )

    def keep(self) -> Image:
        """Store the current image because it is a result.

        Later stencils read the same image as without the result, so their kernels do not change.
        """
        folded, is_open = self.foldable(), self.group is not None
        image = self.close()
        self.folded = folded
        if is_open and not folded:
            self.split = image
        return image

    def foldable(self) -> Read | None:
        """Return the current image as a stored image with passes for taps to recompute, or None."""
        group = self.group
        if not (self.fold and group and group.reads) or group.opener:
            return self.folded
        read = Read(group.reads[0].image, group.ops)
        is_inlined = all(op.is_inlined for op in group.ops)
        return read if is_inlined and read.image is not self.split else None

    def input_of_stencil(self) -> Read:
        """Return the current image for a stencil, which may recompute passes at its taps."""
        read = self.foldable()
        if read is None:
            return Read(self.close())
        if self.group:
            self.group, self.stored = None, read.image
        return read

    def reduce(self, op: Op, reduction: Reduction) -> None:
        """Add the launches of a reduction over the current image."""
        if reduction.bins:
            stored = Read(self.close())
            self.launches.append(Histogram(op, (stored,), f"{op.step}.count", self.level))
        else:
            self.close(sums=op)
        self.split = None
        self.launches.append(Reduce(op, f"{op.step}.add_up", self.level))
        self.launches.append(Finalize(op, f"{op.step}.{reduction.finish}", self.level))

    def add_step(self, ops: Sequence[Op]) -> None:
        """Add the passes of a step."""
        local: dict[str, Read] = {}
        if any(op.has_state for op in ops):
            previous = Image(len(self.images), ops[-1].kind, self.level)
            self.images.append(previous)
            self.previous[ops[0].step] = previous
            local[PREVIOUS] = Read(previous)
        over_pixels = [op for op in ops if not isinstance(op.pass_.access, LineTable)]
        if any(isinstance(op.pass_.access, Stencil) and "src" in op.pass_.reads for op in ops):
            # A pass before the stencil continues from the stored image, not from recomputed taps.
            is_first = isinstance(over_pixels[0].pass_.access, Stencil)
            local["src"] = self.input_of_stencil() if is_first else Read(self.close())
        written = "src"
        for op in ops:
            pass_ = op.pass_
            match pass_.access:
                case LineTable():
                    self.lines.setdefault(self.level, []).append(op)
                    continue
                case Reduction() as reduction:
                    self.reduce(op, reduction)
                    continue
                case Stencil():
                    if written not in local:
                        local[written] = Read(self.close())
                    self.group = Launch("", (op,), tuple(local[name] for name in pass_.reads))
                case Resample(resampler):
                    self.group = Launch("", (op,), (Read(self.close()),))
                    self.resamplings.append(resampler)
                case Pointwise() | TableLookup() | Bands():
                    if self.group is None:
                        assert self.stored is not None
                        self.group = Launch("", (), (Read(self.stored),))
                    # If the pass to undo is stored already, this pass is still needed.
                    undone = op.undoes_previous and self.group.ops
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
    cpu: Cpu | None = None,
    frame: FrameKind = FrameKind.SINGLE,
) -> Plan:
    """Return the plan of a chain.

    Args:
        chain: the chain.
        half: whether the source is float16, not float32.
        keep: the steps whose images are returned.
        encode: whether the last image is returned in eight bits.
        final: whether the last image is returned in float. Without ``encode`` and ``final``, the
            plan ends with the last step to keep.
        fold: whether a stencil may recompute passes at its taps. It may not for images one pixel
            wide or high, because mirroring changes their Bayer phase.
        planar: whether the source is stored as consecutive planes, not interleaved.
        cpu: the CPU on whose cores launches run in bands. None runs each over the whole image.
        frame: which frame of a sequence the image is. For any but a single image, the results of
            steps with state are kept for the next frame.

    Raises:
        RequestError: the chain lacks a step to keep.
    """
    for name in keep:
        chain.step_named(name)
    if not (encode or final):
        chain = chain.up_to(keep)
    last = chain.steps[-1].name
    final = final or last in keep
    planner = _Planner(chain.source, fold)
    planner.period, *later_periods = border_periods(chain).values()
    kept: dict[str, Image] = {}
    states: list[tuple[str, Image | None, Image]] = []
    arguments = chain.arguments
    later = chain_ops(chain, arguments, FrameKind.LATER)
    with_state = {name for name, ops in later if any(op.has_state for op in ops)}
    steps = chain_ops(chain, arguments, frame)
    for (name, ops), period in zip(steps, [*later_periods, None], strict=True):
        planner.add_step(ops)
        planner.period = period
        if name in with_state and frame is not FrameKind.SINGLE:
            states.append((name, planner.previous.get(name), planner.keep()))
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
    before = [*planner.previous.values()]
    results = [*results, *before, *(after for *_, after in states)]
    pinned = {image.number for image in results}
    if cpu:
        launches = in_bands(launches, pinned, cpu)
    slots, count = assign_slots(launches, planner.images, pinned, before)
    stencils = [op for x in launches if isinstance(x, Launch) for op in x.ops]
    # The frames of a sequence have planes of the same layout.
    stencils += [op for _, ops in later for op in ops if frame is FrameKind.FIRST]
    border = max((op.radius for op in stencils), default=0)
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
        border=border,
        states=tuple(states),
        resamplings=tuple(planner.resamplings),
        bands=chain.bands,
    )
