"""The passes of a chain's steps, from which launches are built."""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from enum import Enum

import numpy as np

from clpipe.chain.chain import Chain, Step, cached_by_structure
from clpipe.stage import (
    PREVIOUS,
    Argument,
    CompileTime,
    Kind,
    Pass,
    Pointwise,
    Reduction,
    Resample,
    Stencil,
    bytes_of,
)


class FrameKind(Enum):
    """Which frame of a sequence an image is."""

    SINGLE = "it belongs to no sequence"
    FIRST = "there is no frame before"
    LATER = "stages with state read what they wrote for the frame before"


@dataclass(frozen=True)
class Op:
    """One pass of one step, with the types of its run-time arguments and its literals."""

    step: str
    kernel: str  # file, relative to the kernel folder; a plug-in's is an absolute path
    pass_: Pass
    source: Kind  # of the image "src" that the stage reads
    kind: Kind  # of the image that the pass writes
    types: tuple[tuple[str, str], ...]  # argument -> OpenCL type
    literals: tuple[tuple[str, str], ...]  # argument -> OpenCL text
    undoes_previous: bool = False  # whether it undoes the previous pass, of another step

    def __hash__(self) -> int:
        # These fields distinguish most passes. Hashing all fields would slow down plan look-ups.
        return hash((self.step, self.pass_.function, self.literals))

    @property
    def is_inlined(self) -> bool:
        """Whether a later stencil may recompute this pass at each of its taps."""
        access = self.pass_.access
        return isinstance(access, Pointwise) and access.inline_at_taps

    @property
    def has_state(self) -> bool:
        """Whether the pass reads its stage's result for the frame before."""
        return PREVIOUS in self.pass_.reads

    @property
    def radius(self) -> int:
        """The largest distance, in pixels, at which the pass reads."""
        access = self.pass_.access
        return access.radius if isinstance(access, Stencil | Resample) else 0

    @property
    def reduction(self) -> Reduction:
        """The access of the pass, which must be a reduction."""
        assert isinstance(self.pass_.access, Reduction)
        return self.pass_.access


def chain_ops(
    chain: Chain,
    arguments: Mapping[str, Mapping[str, Argument]],
    frame: FrameKind = FrameKind.SINGLE,
) -> tuple[tuple[str, tuple[Op, ...]], ...]:
    """Return each step's name and passes. Chains with the same passes share a plan.

    Args:
        chain: the chain.
        arguments: the arguments of the steps' methods, by step.
        frame: whether there is a frame before. If not, steps with state have no passes.
    """
    steps: list[tuple[str, tuple[Op, ...]]] = []
    last: Op | None = None
    for step in chain.steps:
        step_arguments = arguments[step.name]
        ops = ops_of(step, step_arguments)
        if frame is not FrameKind.LATER and any(op.has_state for op in ops):
            ops = ()
        if ops:
            if last and undoes(ops[0].pass_, step_arguments, last.pass_, arguments[last.step]):
                ops = (replace(ops[0], undoes_previous=True), *ops[1:])
            last = ops[-1]
        steps.append((step.name, ops))
    return tuple(steps)


@cached_by_structure
def _inverse_pairs(chain: Chain) -> dict[bool, list[tuple[str, Pass, str, Pass]]]:
    """Return the passes that may undo the pass before, and those passes, each with its step.

    They are given by whether steps with state have passes.
    """
    found: dict[bool, list[tuple[str, Pass, str, Pass]]] = {False: [], True: []}
    for with_state, pairs in found.items():
        last: tuple[str, Pass] | None = None
        for step in chain.steps:
            passes = step.passes
            if not passes or (not with_state and any(PREVIOUS in each.reads for each in passes)):
                continue
            access = passes[0].access
            if last and isinstance(access, Pointwise) and access.inverse_of == last[1].function:
                pairs.append((step.name, passes[0], *last))
            last = step.name, passes[-1]
    return found


def undone(chain: Chain, frame: FrameKind) -> tuple[bool, ...]:
    """Return which passes undo the pass before them.

    This depends on numbers, so chains of one structure may differ in it, and so do their plans.
    """
    pairs = _inverse_pairs(chain)[frame is FrameKind.LATER]
    if not pairs:
        return ()
    arguments = chain.arguments
    return tuple([undoes(p, arguments[s], q, arguments[t]) for s, p, t, q in pairs])


def border_periods(chain: Chain) -> dict[str, tuple[int, int] | None]:
    """Return the period of each step's mosaic, if borders must be filled by it."""
    arrays = {step.name: step.context.array for step in chain.steps}
    return {n: a.period if a and a.needs_border else None for n, a in arrays.items()}


def undoes(
    pass_: Pass,
    arguments: Mapping[str, Argument],
    previous: Pass,
    previous_arguments: Mapping[str, Argument],
) -> bool:
    """Return whether a pass with its arguments undoes the previous pass with its arguments."""
    access = pass_.access
    if not isinstance(access, Pointwise) or access.inverse_of != previous.function:
        return False
    for mine, theirs in zip(pass_.arguments, previous.arguments, strict=True):
        one, other = arguments[mine], previous_arguments[theirs]
        if one is not other and bytes_of(one) != bytes_of(other):
            return False
    return True


def ops_of(step: Step, arguments: Mapping[str, Argument]) -> tuple[Op, ...]:
    """Return the passes of a step with the types of its arguments. They determine the source."""
    passes = step.passes
    if not passes:
        return ()
    types, literals = [], []
    for name, value in arguments.items():
        if isinstance(value, CompileTime):
            literals.append((name, value.text))
        elif isinstance(value, np.ndarray):
            types.append((name, "__global const float *"))
        else:
            types.append((name, {"f": "float", "u": "uint", "i": "int"}[value.dtype.kind]))
    kernel = f"{step.method.kernel}.cl"
    if step.stage.folder:
        kernel = str(step.stage.folder / kernel)
    argument_types = tuple(types), tuple(literals)
    source, result = step.stage.reads, step.stage.writes
    return tuple(
        Op(step.name, kernel, p, source, p.kind or result, *argument_types) for p in passes
    )
