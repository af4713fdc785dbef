"""The compiled kernels of plans, kept while they are in use."""

from collections.abc import Callable, Iterator
from functools import partial
from typing import Generic, TypeVar

from clpipe.base.cache import BoundedCache
from clpipe.engine.calls import Call
from clpipe.engine.codegen import write_kernel
from clpipe.engine.ir import AnyLaunch, Border, Launch, Plan
from clpipe.engine.programs import Programs, tell_watchers
from clpipe.engine.stack import StackKernel

PLANS = 64  # whose kernels stay at hand

K = TypeVar("K")


class PlanKernels(Generic[K]):
    """The kernels of plans, of one kind.

    Args:
        make: compiles the kernel of a launch of a plan.
    """

    def __init__(self, make: Callable[[Plan, AnyLaunch | Border], K]) -> None:
        self._make = make
        self._plans: BoundedCache[list[K]] = BoundedCache(PLANS)
        self._borders: BoundedCache[K] = BoundedCache(PLANS)

    def __contains__(self, plan: Plan) -> bool:
        """Whether the kernels of a plan are compiled."""
        return plan.unscaled in self._plans

    def of(self, plan: Plan) -> list[K]:
        """The kernels of a plan, from the first call on without compiling.

        Raises:
            DeviceError: one does not compile; the message is the compiler's.
        """
        return self._plans.get(plan.unscaled, lambda: list(self._compiled(plan)))

    def _compiled(self, plan: Plan) -> Iterator[K]:
        count = len(plan.launches)
        for number, launch in enumerate(plan.launches):
            tell_watchers(number, count)
            yield self._make(plan, launch)
        tell_watchers(count, count)

    def borders(self, plan: Plan, written: Launch) -> Iterator[K]:
        """Those that fill the borders of the planes that a launch has written."""
        if not (image := written.writes):
            return
        for slot in plan.slots[image.number]:
            border = Border(slot, written.level, image.period)
            yield self._borders.get(border, partial(self._make, plan, border))


def calls_with(programs: Programs, lanes: int) -> PlanKernels[Call]:
    """The kernels over one image, for a device of so many lanes."""

    def make(plan: Plan, launch: AnyLaunch | Border) -> Call:
        kernel = write_kernel(plan, launch, lanes)
        return Call(kernel, programs.kernel(kernel))

    return PlanKernels(make)


def stack_kernels_with(programs: Programs, lanes: int) -> PlanKernels[StackKernel]:
    """The kernels over a stack."""

    def make(plan: Plan, launch: AnyLaunch | Border) -> StackKernel:
        kernel = write_kernel(plan, launch, lanes, stacked=True)
        return StackKernel(kernel, programs.kernel(kernel))

    return PlanKernels(make)
