"""An open OpenCL device, which runs plans on images, whole or in tiles."""

import logging
import os
import threading
import time
from collections.abc import Callable, Sequence
from contextlib import nullcontext
from functools import partial
from typing import Any

from clpipe.base.errors import DeviceError, MemoryLimitError
from clpipe.base.memory import format_bytes
from clpipe.engine.discovery import (
    DeviceInfo,
    check_process,
    choose,
    choose_all,
    devices_of_process,
    find_devices,
    usable_memory,
)
from clpipe.engine.flow import Flight, Flow
from clpipe.engine.ir import Plan
from clpipe.engine.patches import with_patches
from clpipe.engine.plan_kernels import PlanKernels
from clpipe.engine.programs import forget_programs, notice_if_slow, programs_of
from clpipe.engine.recovery import Recovery
from clpipe.engine.stack import (
    BYTES_PER_PIXEL,
    MAX_STACK_BYTES,
    MIN_MEMBERS,
    Stack,
    divide_into_stacks,
)
from clpipe.engine.tiles import Tiling, tiling_of
from clpipe.engine.work import Member, R, Work

log = logging.getLogger(__name__)


class Device:
    """An open device with its queue, compiled kernels and buffers, which images share.

    Several threads may use it, one after the other.

    Args:
        info: the device to open.
        memory: the most bytes that its buffers may use. None is the default of
            :func:`~clpipe.engine.discovery.usable_memory`.

    Raises:
        DeviceError: the device cannot be opened.
    """

    def __init__(self, info: DeviceInfo, memory: int | None = None) -> None:
        import pyopencl as cl

        self.info = info
        self.memory = memory or usable_memory(info)
        self._cl = cl
        self._lock = threading.RLock()  # lets one thread use the flow
        self._process = os.getpid()
        self._recovery = Recovery(self)
        self._open()

    def _open(self) -> None:
        """Create the queues, in the context that all objects on this device share.

        Raises:
            DeviceError: the device cannot be opened.
        """
        self._programs = programs_of(self.info)
        self._kernels = PlanKernels(self._programs, self.info.lanes)
        try:
            self.flow = Flow(
                self._programs.context, self.info.alignment if self.info.zero_copy else None
            )
        except self._cl.Error as error:
            raise DeviceError(
                f"{self.info.label} cannot be opened: {error}. Close other programs that use it, "
                "or choose another device."
            ) from None

    def check_process(self) -> None:
        """Check that the device was opened in this process.

        Raises:
            DeviceError: this process was forked from the one that opened it.
        """
        check_process(self._process)

    @property
    def bytes_held(self) -> int:
        """The bytes of the buffers that are kept for the next image."""
        return self.flow.pool.bytes

    def limit_memory(self, memory: int) -> None:
        """Limit the device's buffers to ``memory`` bytes. No image may be in flight."""
        with self._lock:
            self.memory = memory
            self._recovery.abandon()

    @property
    def depth(self) -> int:
        """The number of images that the device can process at a time."""
        return self.flow.depth

    def is_compiled(self, plan: Plan) -> bool:
        """Return whether the kernels of a plan are compiled."""
        return plan in self._kernels

    def submit(self, works: Sequence[Work[R]]) -> list[Callable[[], R]]:
        """Enqueue images: large ones in tiles, small ones of the same plan in stacks.

        At most :attr:`depth` stacks are in flight. Before another one is enqueued, this waits for
        the oldest.

        Returns:
            For each image, a callable that waits for its result and returns it. Call each once, in
            the order of the images. Images that fail together are retried one by one; see
            :meth:`clpipe.engine.recovery.Recovery.output`.

        Raises:
            ImageError: an image does not fit into the device's memory, even in tiles. The message
                does not name the image.
            DeviceError: a kernel does not compile, or the process was forked.
        """
        self.check_process()
        with self._lock:
            waits = self._submit(works)
        return [partial(self._locked, waits[work]) for work in works]

    def _locked(self, wait: Callable[[], R]) -> R:
        with self._lock:
            return wait()

    def _submit(self, works: Sequence[Work[R]]) -> dict[Work[R], Callable[[], R]]:
        groups: dict[Any, list[Work[R]]] = {}
        for work in works:
            key = work if work.is_for_itself else work.plan.unscaled
            groups.setdefault(key, []).append(work)
        waits: dict[Work[R], Callable[[], R]] = {}
        for group in groups.values():
            flight = self.enqueue(group, self.memory)
            for work in group:
                waits[work] = self._recovery.wait(work, flight)
        return waits

    def can_stack(self, width: int, height: int) -> bool:
        """Return whether images of this size share launches, :data:`MIN_MEMBERS` or more."""
        return (
            width * height * BYTES_PER_PIXEL * MIN_MEMBERS <= MAX_STACK_BYTES[self.info.zero_copy]
        )

    def enqueue(self, works: Sequence[Work[Any]], memory: int) -> Flight | Exception:
        """Enqueue images whose plans have the same kernels, within ``memory`` bytes.

        Returns:
            The images in flight, or the exception that the device raised.

        Raises:
            ImageError, DeviceError: as for :meth:`submit`.
        """
        plan = works[0].plan
        is_new = plan not in self._kernels
        try:
            with notice_if_slow(self.info) if is_new else nullcontext():
                flight = self._enqueue_group(works, memory)
                if is_new:
                    self.drain()  # PoCL finishes compiling a kernel at its first launch
                    self._programs.keep()
            return flight
        except (self._cl.Error, MemoryError) as error:
            return error

    def _enqueue_group(self, works: Sequence[Work[Any]], memory: int) -> Flight:
        flight, plan = Flight(), works[0].plan
        calls = self._kernels.of(plan)
        borders = partial(self._kernels.borders, plan)
        members: list[Member] = []
        for work in works:
            tiling = self.tiling(work, memory)
            patches = [Member(e, work, number) for number, e in enumerate(tiling.patches)]
            if len(tiling.phases) > 1 or not (patches or len(tiling.tiles) == 1):
                self.flow.start_tiled(flight, work, tiling, calls, borders, self.memory)
            else:
                members += patches or [Member(tiling.tiles[0], work, is_whole=True)]
        if not members:
            return flight
        zero_copy, largest = self.info.zero_copy, self.info.max_buffer
        for part, strides, sizes in divide_into_stacks(
            members, zero_copy, memory, largest, self.depth
        ):
            fetches = part[0].work.options.download
            stack = Stack(part, calls, borders, strides, fetches=fetches)
            self.flow.start(flight, stack, sizes, self.memory)
        return flight

    def reopen(self) -> None:
        """Replace a broken context, with all programs and buffers in it, by a new one.

        Raises:
            DeviceError: the device cannot be opened again.
        """
        log.warning("%s failed. It is opened again.", self.info.label)
        forget_programs(self.info, self._programs)
        self._open()

    def drain(self) -> None:
        """Wait for all enqueued commands, so that none of them uses the host's memory any more."""
        with self._lock:
            self.flow.drain()

    def tiling(self, work: Work[Any], memory: int) -> Tiling:
        """Return the tiles of an image for a limit of ``memory`` bytes.

        Raises:
            ImageError: the image does not fit, even in tiles.
        """
        largest, lanes = min(memory, self.info.max_buffer), self.info.lanes
        tiling = tiling_of(work.plan, *work.size, lanes, memory, largest, self.depth)
        if work.options.state and len(tiling.tiles) > 1:
            (width, height), step = work.size, work.plan.states[0][0]
            raise MemoryLimitError(
                f"{width}x{height} pixels: {step} cannot process a frame in tiles, and the whole "
                f"frame does not fit into {format_bytes(memory)} of {self.info.label}. Allow more "
                f"memory with --memory, or skip {step}."
            )
        if not work.options.boxes:
            return tiling
        return with_patches(work.plan, work.options.boxes, tiling, lanes, memory, self.depth)

    def copy_speed(self, size: int = 96 * 2**20) -> float:
        """Return the speed of a buffer copy, read plus written, in bytes/s: the best of six."""
        cl = self._cl
        source, target = (self.flow.new_buffer(size) for _ in range(2))
        best = 0.0
        for _ in range(6):
            start = time.perf_counter()
            cl.enqueue_copy(self.flow.queue, target, source, byte_count=size).wait()
            best = max(best, 2 * size / (time.perf_counter() - start))
        source.release()
        target.release()
        return best


def open_device(selector: str | None, memory: int | None = None) -> Device | None:
    """Open the device that a selector names; see :func:`choose`.

    Args:
        selector: the device; None is the default device.
        memory: the most bytes that its buffers may use.

    Returns:
        The device; None for the selector "numpy".

    Raises:
        DeviceError: there is no device, none matches, or the matching one cannot be used.
    """
    if selector is not None and selector.lower() == "numpy":
        return None
    return Device(choose(selector, find_devices()), memory)


def open_devices(
    selectors: Sequence[str] = (), memory: int | None = None, share: tuple[int, int] = (0, 1)
) -> list[Device]:
    """Open the devices that selectors name; see :func:`choose_all`.

    Args:
        selectors: the devices; () is the default.
        memory: the most bytes that each device's buffers may use. None divides the free memory
            among CPUs, and a GPU's memory among processes.
        share: the number of this process, and how many processes of this machine share the
            devices; see :func:`~clpipe.engine.discovery.devices_of_process`.

    Returns:
        The devices; an empty list for the selector "numpy".

    Raises:
        DeviceError: as for :func:`open_device`, or "numpy" is combined with other devices.
    """
    if any(selector.lower() == "numpy" for selector in selectors):
        if len(selectors) > 1:
            names = ", ".join(selectors)
            raise DeviceError(
                f"devices {names}: numpy cannot be combined with other devices. Name it alone."
            )
        return []
    chosen = choose_all(selectors, find_devices())
    processes = share[1]
    processes_per_gpu = -(-processes // len(chosen))
    cpu_users = max(sum(info.type != "GPU" for info in chosen), processes)
    return [
        Device(
            info,
            memory
            or usable_memory(info) // (processes_per_gpu if info.type == "GPU" else cpu_users),
        )
        for info in devices_of_process(chosen, *share)
    ]
