"""Chains that merge several exposures of a scene whose light changes between them."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from clpipe.base.errors import RequestError
from clpipe.base.types import Floats
from clpipe.chain.chain import Chain, Step, of_structure
from clpipe.stage import Reduction, Span
from clpipe.stages.sensor_noise.staggered import Staggered
from clpipe.stages.shutter import Rows


@dataclass(frozen=True)
class Exposures:
    """The exposures of a chain.

    Args:
        chain: the chain.
        place: the index of the step that merges the exposures.
        spans: the time span of each exposure.
    """

    chain: Chain
    place: int
    spans: tuple[Span, ...]

    @property
    def step(self) -> Step:
        """The step that merges the exposures."""
        return self.chain.steps[self.place]

    @cached_property
    def later(self) -> tuple[Chain, ...]:
        """The chains of all exposures except the first, up to the step that merges them."""
        return tuple(self._before(number) for number in range(1, len(self.spans)))

    def _before(self, number: int) -> Chain:
        steps = tuple(
            replace(step, method=step.method.for_exposure(self.spans, number))
            if isinstance(step.method, Rows)
            else step
            for step in self.chain.steps[: self.place]
        )
        return replace(self.chain, steps=steps)

    def merging(self, images: Sequence[Floats]) -> Chain:
        """Return the chain that merges ``images``, the results of the chains in :attr:`later`."""
        method = self.step.method
        assert isinstance(method, Staggered)
        own = replace(self.step, method=method.with_later_images(np.stack(images)))
        before, after = self.chain.steps[: self.place], self.chain.steps[self.place + 1 :]
        return replace(self.chain, steps=(*before, own, *after))


def exposures_of(chain: Chain) -> Exposures | None:
    """Return the exposures of a chain; None if it has one, or if the light does not change."""
    place = _place(chain)
    if place is None:
        return None
    method = chain.steps[place].method
    assert isinstance(method, Staggered)
    return Exposures(chain, place, method.spans)


@of_structure
def _place(chain: Chain) -> int | None:
    """Return the index of the step that merges a chain's exposures, see :func:`exposures_of`."""
    for place, step in enumerate(chain.steps):
        if isinstance(step.method, Staggered) and len(step.method.spans) > 1:
            return place
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
            f"{merging.name}: each of its exposures sees another moment, but an image that "
            f"enters at {first.name} shows one moment; start at an earlier stage, or remove "
            "subframes and flicker"
        )
    for step in chain.steps[: exposures.place]:
        if any(isinstance(each.access, Reduction) for each in step.method.passes()):
            raise RequestError(
                f"{step.name}.method={step.method.method}: this method would measure each exposure "
                f"of {merging.name} separately; use another method, such as gain with an ev"
            )
