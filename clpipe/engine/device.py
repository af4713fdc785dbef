"""An open OpenCL device: it puts images through plans, whole or in tiles."""

import logging
import time
from collections.abc import Callable, Sequence
from contextlib import nullcontext
from functools import partial

from clpipe.base.errors import DeviceError
from clpipe.base.types import Array
from clpipe.engine.bindings import Bind
from clpipe.engine.buffers import HostImages, room_for
from clpipe.engine.discovery import (
    DeviceInfo,
    choose,
    choose_all,
    find_devices,
    shared_out,
    usable_memory,
)
from clpipe.engine.flow import DeviceImage, Flow
from clpipe.engine.ir import Plan
from clpipe.engine.members import ImageTask, Member
from clpipe.engine.options import RunOptions
from clpipe.engine.patches import with_patches
from clpipe.engine.plan_kernels import calls_with, stack_kernels_with
from clpipe.engine.programs import announced, forget_programs, programs_of
from clpipe.engine.recovery import Recovery
from clpipe.engine.stack import Stack, cut, members_of
from clpipe.engine.stack import start as start_stack
from clpipe.engine.tiles import Tiling, tiling_of

log = logging.getLogger(__name__)


class Device:
    """An open device with its queue, compiled kernels and buffers, kept from image to image.

    One thread may use it at a time; several devices can run at once, each in a thread of its own.

    Args:
        chosen: which device.
        memory: bytes that its buffers may take; None is what it reports. A CPU shares its memory
            with everybody, so it is at most half of what is available now.

    Raises:
        DeviceError: it cannot be opened.
    """

    def __init__(self, chosen: DeviceInfo, memory: int | None = None) -> None:
        import pyopencl as cl

        self.info = chosen
        self.memory = memory or usable_memory(chosen)
        self._cl = cl
        self._recovery = Recovery(self)
        self._open()

    def _open(self) -> None:
        """Make queues, and nothing else yet, in the context that all on this device share.

        Raises:
            DeviceError: the device cannot be opened.
        """
        self._programs = programs_of(self.info)
        self._calls = calls_with(self._programs, self.info.lanes)
        self._stack_kernels = stack_kernels_with(self._programs, self.info.lanes)
        try:
            self.flow = Flow(
                self._programs.context, self.info.alignment if self.info.in_place else None
            )
        except self._cl.Error as error:
            raise DeviceError(f"{self.info.label} cannot be opened: {error}") from None

    @property
    def bytes_held(self) -> int:
        """Device memory of the buffers that are kept from image to image."""
        return self.flow.pool.bytes

    def limit(self, memory: int) -> None:
        """Let its buffers take no more than these bytes; nothing may be on the way."""
        self.memory = memory
        self._recovery.abandon()

    @property
    def depth(self) -> int:
        """The number of images that it can work on at a time."""
        return self.flow.depth

    def is_compiled(self, plan: Plan) -> bool:
        """Whether the kernels of a plan are compiled."""
        return plan in self._calls

    def keep_programs(self) -> None:
        """Keep for later processes what was compiled, and launched once, since the last time."""
        self._programs.keep()

    def submit(
        self, plan: Plan, source: Array, bind: Bind, options: RunOptions
    ) -> Callable[[], HostImages]:
        """Enqueue one image for a plan, in tiles if it does not fit into the memory.

        So many images are on the way at a time as :attr:`depth` says; before one more is enqueued,
        the oldest is waited for.

        Args:
            plan: the plan.
            source: the image, (height, width[, channel]), of a type that converts without loss to
                what the plan reads, half or float. It must stay as it is until the results are
                taken.
            bind: gives the values of kernel parameters.
            options: what comes back, and how.

        Returns:
            What waits for the results and gives them, called once and in the order of images; see
            :meth:`clpipe.engine.recovery.Recovery.result`.

        Raises:
            ImageError: the image does not fit into the device's memory, not even in tiles.
            DeviceError: a kernel does not compile.
        """
        task = self._task(plan, source, bind, options)
        enqueued = self.enqueue(task, self.memory)
        return partial(self._recovery.result, task, enqueued, self._recovery.generation)

    def _task(self, plan: Plan, source: Array, bind: Bind, options: RunOptions) -> ImageTask:
        height, width = source.shape[:2]
        output = room_for(plan, width, height, options.into, options.boxes)
        return ImageTask(plan, source, bind, output, options)

    def submit_together(
        self, images: Sequence[tuple[Plan, Array, Bind, RunOptions]]
    ) -> list[Callable[[], HostImages]] | None:
        """Enqueue images, or patches of them, in common launches; see :mod:`clpipe.engine.stack`.

        Args:
            images: what :meth:`submit` takes, of each; their plans have the same kernels.

        Returns:
            What waits for the results of each, as :meth:`submit` does; a stack that fails is done
            again image by image. None where they are too large, or need launches of their own.

        Raises:
            ImageError, DeviceError: as :meth:`submit`.
        """
        if sum(max(len(options.boxes), 1) for *_, options in images) < 2:
            return None
        tasks = [self._task(*image) for image in images]
        members = [members_of(task, self.tiling(task, self.memory)) for task in tasks]
        placed = [each for own in members for each in own or ()]
        in_place, largest = self.info.in_place, self.info.max_buffer
        stacks = cut(placed, in_place, self.memory, largest, self.depth) if all(members) else None
        if not stacks:
            return None
        begun = self._begin(stacks)
        wait, generation = self._recovery.result_of_stacks, self._recovery.generation
        return [partial(wait, task, begun, generation) for task in tasks]

    def _begin(
        self, stacks: Sequence[tuple[Sequence[Member], dict[str, int]]]
    ) -> list[Stack] | Exception:
        """Enqueue stacks; what the device raises is returned."""
        begun: list[Stack] = []
        plan = stacks[0][0][0].task.plan
        is_new = plan not in self._stack_kernels
        try:
            with announced(self.info) if is_new else nullcontext():
                kernels = self._stack_kernels.of(plan)
            borders = partial(self._stack_kernels.borders, plan)
            for members, strides in stacks:
                begun.append(Stack(members, kernels, borders, strides))
                start_stack(self.flow, begun[-1], self.memory)
            if is_new:
                self.drain()  # PoCL is done with a kernel when it has been launched
                self.keep_programs()
            return begun
        except (self._cl.Error, MemoryError) as error:
            return error

    def reopen(self) -> None:
        """Leave a context that is of no more use, with all that is in it, for a new one.

        Raises:
            DeviceError: the device cannot be opened again.
        """
        log.warning("%s failed, and is opened again", self.info.label)
        forget_programs(self.info, self._programs)
        self._open()

    def drain(self) -> None:
        """Wait for what was enqueued, so that it uses no memory of the host any more."""
        self.flow.drain()

    def tiling(self, task: ImageTask, memory: int) -> Tiling:
        """Return the tiles of an image within so many bytes."""
        height, width = task.source.shape[:2]
        largest = min(memory, self.info.max_buffer)
        lanes = self.info.lanes
        tiling = tiling_of(task.plan, width, height, lanes, memory, largest, self.depth)
        if not task.options.boxes:
            return tiling
        return with_patches(task.plan, task.options.boxes, tiling, lanes, memory, self.depth)

    def enqueue(self, task: ImageTask, memory: int) -> DeviceImage | Exception:
        """Enqueue an image; what the device raises is returned."""
        try:
            borders = partial(self._calls.borders, task.plan)
            tiling = self.tiling(task, memory)
            image = DeviceImage(task, self._calls.of(task.plan), borders, tiling)
            self.flow.start(image, self.memory)
            return image
        except (self._cl.Error, MemoryError) as error:
            return error

    def copy_speed(self, size: int = 96 * 2**20) -> float:
        """Bytes a second, read plus written, of the device's own buffer copy; the best of five."""
        cl = self._cl
        one, two = (self.flow.new_buffer(size) for _ in range(2))
        best = 0.0
        for _ in range(6):
            start = time.perf_counter()
            cl.enqueue_copy(self.flow.queue, two, one, byte_count=size).wait()
            best = max(best, 2 * size / (time.perf_counter() - start))
        one.release()
        two.release()
        return best


def open_device(selector: str | None, memory: int | None = None) -> Device | None:
    """Open the device that a selector names, see :func:`choose`; None stands for "numpy".

    ``memory`` is how many bytes its buffers may take.

    Raises:
        DeviceError: there is no device, none matches, or the one that matches cannot be used.
    """
    if selector is not None and selector.lower() == "numpy":
        return None
    return Device(choose(selector, find_devices()), memory)


def open_devices(
    selectors: Sequence[str] = (), memory: int | None = None, share: tuple[int, int] = (0, 1)
) -> list[Device]:
    """Open the devices that selectors name, see :func:`choose_all`; an empty list for "numpy".

    Args:
        selectors: of the devices.
        memory: bytes that the buffers of each may take; without it, CPUs share what is free, and
            processes share a GPU's.
        share: the number of this process and of how many, where several of this machine share the
            devices, see :func:`~clpipe.engine.discovery.shared_out`.

    Raises:
        DeviceError: as :func:`open_device`, or "numpy" stands beside others.
    """
    if any(selector.lower() == "numpy" for selector in selectors):
        if len(selectors) > 1:
            raise DeviceError(f"found devices {', '.join(selectors)}; numpy is used alone")
        return []
    chosen = choose_all(selectors, find_devices())
    processes = share[1]
    on_each_gpu = -(-processes // len(chosen))
    on_cpus = max(sum(info.type != "GPU" for info in chosen), processes)
    return [
        Device(
            info, memory or usable_memory(info) // (on_each_gpu if info.type == "GPU" else on_cpus)
        )
        for info in shared_out(chosen, *share)
    ]
