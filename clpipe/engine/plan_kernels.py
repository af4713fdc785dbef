"""The compiled kernels of recently used plans."""

from collections.abc import Iterator
from functools import partial

from clpipe.base.cache import BoundedCache
from clpipe.engine.codegen import write_kernel
from clpipe.engine.ir import AnyLaunch, Border, Launch, Plan
from clpipe.engine.programs import Programs, notify_watchers
from clpipe.engine.stack import Call

MAX_PLANS = 64  # the most plans whose kernels are cached


class PlanKernels:
    """The kernels of plans, for a device.

    Args:
        programs: the compiled programs of the device.
        lanes: the lanes of the device.
    """

    def __init__(self, programs: Programs, lanes: int) -> None:
        self._programs = programs
        self._lanes = lanes
        self._plans: BoundedCache[list[Call]] = BoundedCache(MAX_PLANS)
        self._borders: BoundedCache[Call] = BoundedCache(MAX_PLANS)

    def __contains__(self, plan: Plan) -> bool:
        """Return whether the kernels of a plan are compiled."""
        return plan.unscaled in self._plans

    def of(self, plan: Plan) -> list[Call]:
        """Return the kernels of a plan. The first call compiles them.

        Raises:
            DeviceError: a kernel does not compile. The message contains the compiler's.
        """
        return self._plans.get(plan.unscaled, lambda: list(self._compile_all(plan)))

    def _compile_all(self, plan: Plan) -> Iterator[Call]:
        count = len(plan.launches)
        for number, launch in enumerate(plan.launches):
            notify_watchers(number, count)
            yield self._compile(plan, launch)
        notify_watchers(count, count)

    def _compile(self, plan: Plan, launch: AnyLaunch | Border) -> Call:
        kernel = write_kernel(plan, launch, self._lanes)
        return Call(kernel, self._programs.kernel(kernel))

    def borders(self, plan: Plan, written: Launch) -> Iterator[Call]:
        """Yield the kernels that fill the borders of the planes written by a launch."""
        if not (image := written.writes):
            return
        for slot in plan.slots[image.number]:
            border = Border(slot, written.level, image.period)
            yield self._borders.get(border, partial(self._compile, plan, border))
