"""Chains that merge several exposures of a scene whose light changes between them."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from clpipe.base.errors import RequestError
from clpipe.base.types import Floats
from clpipe.chain.chain import Chain, Step, cached_by_structure
from clpipe.stage import Reduction, Span, StageRole
from clpipe.stages.sensor_noise.staggered import Staggered
from clpipe.stages.shutter import Rows


@dataclass(frozen=True)
class Exposures:
    """The exposures of a chain.

    Args:
        chain: the chain.
        index: the index of the step that merges the exposures.
        spans: the time span of each exposure.
    """

    chain: Chain
    index: int
    spans: tuple[Span, ...]

    @property
    def step(self) -> Step:
        """The step that merges the exposures."""
        return self.chain.steps[self.index]

    @cached_property
    def later(self) -> tuple[Chain, ...]:
        """The chains of all exposures except the first, up to the step that merges them."""
        return tuple(self._chain_before_merge(number) for number in range(1, len(self.spans)))

    def _chain_before_merge(self, number: int) -> Chain:
        before = replace(self.chain, steps=self.chain.steps[: self.index])
        shutters = {s.name: s.method for s in before.steps if isinstance(s.method, Rows)}
        return before.with_methods(
            {name: method.for_exposure(self.spans, number) for name, method in shutters.items()}
        )

    def merge_chain(self, images: Sequence[Floats]) -> Chain:
        """Return the chain that merges ``images``, the results of the chains in :attr:`later`."""
        method = self.step.method
        assert isinstance(method, Staggered)
        return self.chain.with_methods({self.step.name: method.with_later_images(np.stack(images))})


def exposures_of(chain: Chain) -> Exposures | None:
    """Return the exposures of a chain; None if it has one, or if the light does not change."""
    index = _merge_index(chain)
    if index is None:
        return None
    method = chain.steps[index].method
    assert isinstance(method, Staggered)
    return Exposures(chain, index, method.spans)


def shutter_in(chain: Chain) -> Rows | None:
    """Return the shutter of a chain, for the first of its exposures; None if it has none."""
    step = chain.step_in(StageRole.SHUTTER)
    if step is None or not isinstance(step.method, Rows):
        return None
    exposures = exposures_of(chain)
    return step.method.for_exposure(exposures.spans, 0) if exposures else step.method


@cached_by_structure
def _merge_index(chain: Chain) -> int | None:
    """Return the index of the step that merges a chain's exposures, see :func:`exposures_of`."""
    for index, step in enumerate(chain.steps):
        if isinstance(step.method, Staggered) and len(step.method.spans) > 1:
            return index
    return None


def check_exposures(chain: Chain) -> None:
    """Check that each exposure of a chain can be processed separately.

    Raises:
        RequestError: a step before the merging one does not allow it.
    """
    if not (exposures := exposures_of(chain)):
        return
    first, merging = chain.steps[0], exposures.step
    if first.context.light_changes:
        raise RequestError(
            f"{merging.name}: its exposures show different moments, but an image that starts "
            f"at {first.name} shows only one moment; start at an earlier stage, or remove "
            "subframes and flicker"
        )
    for step in chain.steps[: exposures.index]:
        if any(isinstance(each.access, Reduction) for each in step.method.passes()):
            raise RequestError(
                f"{step.name}.method={step.method.method}: this method would measure each exposure "
                f"of {merging.name} separately; use another method, such as gain with an ev"
            )
