"""Images that are to go through runners: together, where they are small and their chains alike."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

from clpipe.base.types import Array
from clpipe.engine.ir import Plan
from clpipe.engine.options import RunOptions

if TYPE_CHECKING:
    from clpipe.engine.runner import Result, Runner

DEFAULTS = RunOptions()


def check_resamplings(plan: Plan, width: int, height: int) -> None:
    """See that an image of that size can be resampled as a plan does.

    Raises:
        ImageError: it cannot, as a lens would fold it over.
    """
    for resampling, size in zip(plan.resamplings, plan.sizes(width, height), strict=False):
        resampling.values(*size)


@dataclass(frozen=True)
class Submission:
    """An image that is to be put through a runner; see :meth:`Runner.submit`."""

    runner: "Runner"
    image: Array
    noise_key: str
    options: RunOptions = DEFAULTS

    def merging(self) -> "Submission":
        """The same with all exposures but the first done, where the chain has several."""
        runner = self.runner.merging(self.image, self.noise_key, self.options.later)
        if runner is self.runner:
            return self
        return replace(self, runner=runner, options=replace(self.options, later=()))


def submit_together(submissions: Sequence[Submission]) -> list[Callable[[], "Result"]]:
    """Enqueue images, and small ones of alike chains in common launches.

    Returns:
        What waits for the result of each and gives it, called once and in order.

    Raises:
        ImageError, DeviceFailedError, DeviceError: as :meth:`Runner.submit`.
    """
    waiting: dict[int, Callable[[], Result]] = {}
    groups: dict[tuple[int, Plan], list[tuple[int, Submission, Plan]]] = {}
    for number, asked in enumerate(submissions):
        asked.runner.check(asked.image, asked.options)
        each = asked.merging()
        if alone := each.runner.without_device(each.image, each.noise_key, each.options):
            waiting[number] = alone
        else:
            plan = each.runner.plan_for(each.image)
            check_resamplings(plan, *each.image.shape[1::-1])
            key = id(each.runner.device), plan.unscaled
            groups.setdefault(key, []).append((number, each, plan))
    for group in groups.values():
        waiting |= zip((number for number, *_ in group), _begin(group), strict=True)
    return [waiting[number] for number in range(len(submissions))]


def _begin(group: Sequence[tuple[int, Submission, Plan]]) -> list[Callable[[], "Result"]]:
    """Enqueue images of one device, whose plans have the same kernels."""
    device = group[0][1].runner.device
    assert device
    images = [
        (plan, each.image, each.runner.bind(plan, each.image, each.noise_key), each.options)
        for _, each, plan in group
    ]
    if results := device.submit_together(images):
        return [
            each.runner.waiting(plan, each.image, result)
            for (_, each, plan), result in zip(group, results, strict=True)
        ]
    return [
        each.runner.submit_alone(plan, each.image, each.noise_key, each.options)
        for _, each, plan in group
    ]
