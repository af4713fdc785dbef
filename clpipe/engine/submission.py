"""Images that are to go through devices: together, where they are small and their chains alike."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Generic, TypeVar

from clpipe.base.errors import DeviceFailedError, ImageError
from clpipe.base.types import Array
from clpipe.engine.bindings import Bind
from clpipe.engine.buffers import HostImages
from clpipe.engine.device import Device
from clpipe.engine.ir import Plan
from clpipe.engine.options import RunOptions

R = TypeVar("R")


@dataclass(frozen=True)
class Work(Generic[R]):
    """An image that is to go through a device.

    Args:
        device: the device.
        plan: what is done.
        image: (height, width[, channel]).
        bind: returns the values of kernel parameters.
        options: what comes back, and how.
        compile: compiles the plan's kernels, if they are not compiled yet.
        finish: makes a result of what comes back.
    """

    device: Device
    plan: Plan
    image: Array
    bind: Bind
    options: RunOptions
    compile: Callable[[], None]
    finish: Callable[[HostImages], R]

    @property
    def order(self) -> tuple[Plan, Array, Bind, RunOptions]:
        """What the device takes."""
        return self.plan, self.image, self.bind, self.options

    def waiting(self, results: Callable[[], HostImages]) -> Callable[[], R]:
        """Return a callable that waits for the results of the device and returns the result."""
        return lambda: self.finish(results())


def submit_together(works: Sequence[Work[R] | Callable[[], R]]) -> list[Callable[[], R]]:
    """Enqueue images, and small ones of alike chains in common launches.

    Args:
        works: the images. A callable in place of one needs no device: it returns the result.

    Returns:
        A callable for each, which waits for its result and returns it; called once and in order.

    Raises:
        ImageError, DeviceFailedError, DeviceError: as :meth:`Device.submit`.
    """
    waiting: dict[int, Callable[[], R]] = {}
    groups: dict[tuple[int, Plan], list[tuple[int, Work[R]]]] = {}
    for number, each in enumerate(works):
        if isinstance(each, Work):
            groups.setdefault((id(each.device), each.plan.unscaled), []).append((number, each))
        else:
            waiting[number] = each
    for group in groups.values():
        begun = _begin([each for _, each in group])
        waiting |= zip((number for number, _ in group), begun, strict=True)
    return [waiting[number] for number in range(len(works))]


def _begin(works: Sequence[Work[R]]) -> list[Callable[[], R]]:
    """Enqueue images of one device, whose plans have the same kernels."""
    if results := works[0].device.submit_together([each.order for each in works]):
        return [each.waiting(result) for each, result in zip(works, results, strict=True)]
    return [_begin_alone(each) for each in works]


def _begin_alone(work: Work[R]) -> Callable[[], R]:
    """Enqueue an image by itself."""
    try:
        work.compile()
    except DeviceFailedError:
        raise
    except ImageError:
        pass  # the tiny image is too large; the device says it of this image
    return work.waiting(work.device.submit(*work.order))
