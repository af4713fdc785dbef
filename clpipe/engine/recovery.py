"""Recovery from device failures: images are retried, if necessary in a new context."""

import time
from collections.abc import Callable, Sequence
from typing import Any, Protocol

import numpy as np

from clpipe.base.errors import DeviceError, DeviceFailedError, ImageError
from clpipe.engine.buffers import HostImages
from clpipe.engine.discovery import DeviceInfo
from clpipe.engine.flow import Flight, Flow
from clpipe.engine.options import Timing
from clpipe.engine.tiles import Tiling
from clpipe.engine.work import R, Work

MAX_FAILURES = 3  # images in a row for which a device may fail before it is no longer used


class OpenDevice(Protocol):
    """A device that can be opened again, :class:`clpipe.engine.device.Device`."""

    info: DeviceInfo
    flow: Flow
    memory: int

    def enqueue(self, works: Sequence[Work[Any]], memory: int) -> Flight | Exception:
        """Enqueue images within ``memory`` bytes, or return the exception of the device."""

    def tiling(self, work: Work[Any], memory: int) -> Tiling:
        """Return the tiles of an image for a limit of ``memory`` bytes."""

    def reopen(self) -> None:
        """Open the device again, in a new context."""


class Recovery:
    """Waits for images on a device, and retries those that fail.

    Args:
        device: the device.

    Attributes:
        generation: a number that increases each time all data on the device is lost.
    """

    def __init__(self, device: OpenDevice) -> None:
        import pyopencl as cl

        self.generation = 0
        self._cl = cl
        self._device = device
        self._failures = 0  # images in a row

    def wait(self, work: Work[R], flight: Flight | Exception) -> Callable[[], R]:
        """Return a callable that waits for an enqueued image and returns its result."""
        output, generation = self.output, self.generation
        return lambda: work.finish(output(work, flight, generation))

    def output(self, work: Work[Any], flight: Flight | Exception, generation: int) -> HostImages:
        """Wait for the output of an image that was enqueued in a generation.

        If the device runs out of memory below the limit, the buffers of earlier images are released
        first. Then the image is retried with smaller tiles. If a kernel fails, the image is retried
        once, in a new context if the old one is broken. Images that fail together are retried one
        by one, and only these failures count. Frames of a sequence with state are not retried,
        because a later frame may have replaced the state.

        Raises:
            ImageError: the memory is too small even for the smallest tiles.
            DeviceFailedError: the device failed twice, or for a frame of a sequence with state.
            DeviceError: the device failed for :data:`MAX_FAILURES` images in a row.
        """
        cl, device = self._cl, self._device
        memory = device.memory
        full: Exception | None = None  # the error when the device's memory was full
        failed = False
        if state := work.options.state:
            if generation != self.generation:  # its commands, or those of a frame before, are lost
                state.is_lost = True
            state.check()
        while True:
            if generation != self.generation:  # the enqueued commands are lost
                try:
                    flight, generation = device.enqueue([work], memory), self.generation
                except ImageError:
                    if full is None:
                        raise
                    width, height = work.size
                    raise ImageError(
                        f"{width}x{height} pixels: {device.info.label} is out of memory, even with "
                        f"the smallest tiles ({full}). Close other programs that use the device."
                    ) from None
            try:
                if isinstance(flight, Exception):
                    raise flight
                device.flow.finish(flight)
            except (cl.Error, MemoryError) as error:
                is_full = isinstance(error, cl.MemoryError | MemoryError)
                survives = self._context_survives()
                if state:
                    state.is_lost = True
                elif survives and is_full:
                    memory = memory if full is None else device.tiling(work, memory).bytes // 2
                    full = error
                    continue
                if not (failed or state):
                    failed = True
                    continue
                self._count_failure(error)
                raise DeviceFailedError(f"{device.info.label} failed: {error}") from None
            self._failures = 0
            if work.options.timings is not None:
                work.options.timings.extend(timings_of(flight.events))
            return work.output if work.options.download else HostImages({}, None, {})

    def abandon(self) -> None:
        """Wait for all commands and release all memory. Images in flight must be enqueued again."""
        self.generation += 1
        self._device.flow.abandon()

    def _context_survives(self) -> bool:
        """Abandon all images after an error, and reopen the device if its context is broken.

        Returns:
            Whether the context still works.

        Raises:
            DeviceError: the device cannot be opened again.
        """
        self.abandon()
        if self._copy_works():
            return True
        self._device.reopen()
        return False

    def _copy_works(self) -> bool:
        """Return whether the context still works after an error. This copies a few bytes.

        Error codes are not enough. NVIDIA reports an invalid read in a kernel as
        CL_OUT_OF_RESOURCES, which also means too little memory. But after an invalid read, every
        command in that context fails.
        """
        cl, sent, received = self._cl, np.arange(4, dtype=np.uint8), np.zeros(4, np.uint8)
        flow = self._device.flow
        try:
            queue = flow.new_queue()
            flags = cl.mem_flags.READ_WRITE | cl.mem_flags.COPY_HOST_PTR
            cl.enqueue_copy(queue, received, cl.Buffer(flow.context, flags, hostbuf=sent))
            queue.finish()
        except cl.Error:
            return False
        return np.array_equal(sent, received)

    def _count_failure(self, error: Exception) -> None:
        """Count an image for which the device failed twice.

        Raises:
            DeviceError: the device failed for too many images in a row.
        """
        self._failures += 1
        if self._failures >= MAX_FAILURES:
            raise DeviceError(
                f"{self._device.info.label} failed for {self._failures} images in a row, so it is "
                f"no longer used: {error}. To choose another one, run clpipe devices."
            ) from None


def timings_of(events: Sequence[tuple[str, Any]]) -> list[Timing]:
    """Return the timings of events. The last event must have just ended."""
    if not events:
        return []
    offset = time.perf_counter() - events[-1][1].profile.end * 1e-9
    transfers = ("upload", "download")
    return [
        Timing(
            name,
            (event.profile.end - event.profile.start) * 1e-9,
            event.profile.start * 1e-9 + offset,
            name in transfers,
        )
        for name, event in events
    ]
