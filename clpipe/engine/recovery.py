"""What happens when a device fails: images are tried again, in a new context if need be."""

import time
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from clpipe.base.errors import DeviceError, DeviceFailedError, ImageError
from clpipe.engine.buffers import HostImages
from clpipe.engine.flow import Flight
from clpipe.engine.options import Timing
from clpipe.engine.work import R, Work

if TYPE_CHECKING:
    from clpipe.engine.device import Device

FAILURES = 3  # images in a row that a device fails at, before it is given up


class Recovery:
    """Waits for images on a device, and tries again what fails.

    Args:
        device: the device.

    Attributes:
        generation: counts up when everything on the device is lost.
    """

    def __init__(self, device: "Device") -> None:
        import pyopencl as cl

        self.generation = 0
        self._cl = cl
        self._device = device
        self._failures = 0  # images in a row

    def wait(self, work: Work[R], flight: Flight | Exception) -> Callable[[], R]:
        """Return a callable that waits for an image that was enqueued and returns its result."""
        output, generation = self.output, self.generation
        return lambda: work.finish(output(work, flight, generation))

    def output(self, work: Work[Any], flight: Flight | Exception, generation: int) -> HostImages:
        """Wait for the output of an image that was enqueued in a generation.

        If the device runs out of memory before the limit is reached, the buffers of earlier images
        are released, then tiles become smaller. If a kernel fails, the image is tried once more, in
        a new context if the old one is of no more use. An image that failed together with others
        is tried again by itself, and only that counts.

        Raises:
            ImageError: memory is not enough for tiles of any size.
            DeviceFailedError: the device failed twice.
            DeviceError: the device has failed at :data:`FAILURES` images in a row.
        """
        cl, device = self._cl, self._device
        memory = device.memory
        full: Exception | None = None  # the device's error when its memory ran out
        failed = False
        while True:
            if generation != self.generation:  # what was enqueued is lost
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
                if self._context_survives() and is_full:
                    memory = memory if full is None else device.tiling(work, memory).bytes // 2
                    full = error
                    continue
                if not failed:
                    failed = True
                    continue
                self._count_failure(error)
                raise DeviceFailedError(f"{device.info.label} failed: {error}") from None
            self._failures = 0
            if work.options.timings is not None:
                work.options.timings.extend(timed(flight.events))
            return work.output if work.options.download else HostImages({}, None, {})

    def abandon(self) -> None:
        """Wait for everything on the device and release all memory; images must start again."""
        self.generation += 1
        self._device.flow.abandon()

    def _context_survives(self) -> bool:
        """Abandon everything after an error; open the device again if its context is of no use.

        Raises:
            DeviceError: the device cannot be opened again.
        """
        self.abandon()
        if self._works():
            return True
        self._device.reopen()
        return False

    def _works(self) -> bool:
        """Whether the context still does what it is told, after an error.

        Codes do not say: NVIDIA reports a kernel that reads astray as CL_OUT_OF_RESOURCES, which is
        also a lack of memory. But after it everything in that context fails.
        """
        cl, sent, back = self._cl, np.arange(4, dtype=np.uint8), np.zeros(4, np.uint8)
        flow = self._device.flow
        try:
            queue = flow.new_queue()
            flags = cl.mem_flags.READ_WRITE | cl.mem_flags.COPY_HOST_PTR
            cl.enqueue_copy(queue, back, cl.Buffer(flow.context, flags, hostbuf=sent))
            queue.finish()
        except cl.Error:
            return False
        return np.array_equal(sent, back)

    def _count_failure(self, error: Exception) -> None:
        """Count an image that the device failed at, though it was tried again.

        Raises:
            DeviceError: there were too many in a row.
        """
        self._failures += 1
        if self._failures >= FAILURES:
            raise DeviceError(
                f"{self._device.info.label} failed for {self._failures} images in a row, so it is "
                f"no longer used: {error}"
            ) from None


def timed(events: Sequence[tuple[str, Any]]) -> list[Timing]:
    """The timings of events. The queue has just been finished, so the last one ends now."""
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
