"""Limits the images in flight by their memory, and rejects images that never fit."""

import threading
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from math import prod
from typing import Self

from clpipe.base.errors import ImageError, MemoryLimitError
from clpipe.base.memory import FreeMemory, available_memory, format_bytes, free_memory
from clpipe.base.system import trim_memory
from clpipe.chain.chain import Chain
from clpipe.chain.formats import DNG, FORMATS
from clpipe.engine.device import Device
from clpipe.images.claims import MemoryClaim

FLOAT_PIXEL = 12  # bytes; a pixel of three floats
NUMPY_PIXEL = 16 * FLOAT_PIXEL  # bytes; a pixel while the chain runs in NumPy (measured: 152)
UNCOUNTED = 8 << 20  # bytes; memory that is not counted, in addition to an eighth of an image
COMPILE_MEMORY = 160 << 20  # bytes; memory for compiling all kernels (measured: 100 to 140 MiB)
MIN_DEVICE_MEMORY = 32 << 20  # bytes; device memory that suffices for a large image in tiles
WAIT_SECONDS = 1.0  # s; the wait for memory that earlier images free shortly after they end
# s; a measurement is reused for this time. It takes 0.4 ms, and a small image takes 10 ms.
MEASUREMENT_SECONDS = 0.1


def default_budget(sharing: int = 1) -> int | None:
    """Return the bytes that images in flight may take: half of the free memory.

    The other half is for devices. ``sharing`` is the number of processes that share the memory. The
    result is None if the system does not report free memory.
    """
    free = available_memory()
    return None if free is None else free // 2 // sharing


def host_bytes(
    claim: MemoryClaim,
    chain: Chain,
    renditions: int,
    formats: Sequence[str],
    keep: Sequence[str],
    extra_images: int = 0,
    in_numpy: bool = False,
) -> int:
    """Estimate the peak host memory, in bytes, of an image in flight.

    Memory of devices is not included. At 6 and 24 MP the estimate was 1.05 to 2.7 times the
    measured memory.

    Args:
        claim: the size in the header of its file.
        chain: its chain.
        renditions: the number of its results that exist at a time.
        formats: the formats of the last image and of the raw.
        keep: the steps whose image is also written.
        extra_images: the number of further images of three floats: one for the sum of sub-frames,
            and two for each further exposure and each carried layer.
        in_numpy: whether NumPy develops it.

    Raises:
        ImageError: the chain cannot process an image of this size.
    """
    pixels = claim.width * claim.height
    if not pixels:
        return 0
    float_formats = [FORMATS[name] for name in formats if name != DNG and FORMATS[name].bits > 8]
    kept = len(keep) + bool(float_formats) + (DNG in formats)
    # Encoders of 16-bit integers compute in double precision.
    encoding = max(
        (24 if each.floats else 36 for each in float_formats), default=FLOAT_PIXEL if kept else 1
    )
    size = chain.size(claim.width, claim.height)
    results = prod(size) * renditions * (3 + FLOAT_PIXEL * kept + encoding)
    peak = max(claim.reading, claim.image + results)
    return peak + pixels * (FLOAT_PIXEL * extra_images + NUMPY_PIXEL * in_numpy)


@dataclass(eq=False)
class Lease:
    """The memory of an image in flight; :meth:`MemoryBudget.acquire` returns it.

    Args:
        budget: the budget that the memory is part of.
        size: bytes.
        limits: the usual memory limits of devices whose limit is lowered for this image.
    """

    budget: "MemoryBudget"
    size: int
    limits: "dict[Device, int]" = field(default_factory=dict)

    def release(self) -> None:
        """Release the memory. A second call does nothing."""
        self.budget.take_back(self)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.release()


class MemoryBudget:
    """A memory budget that admits images in order, as soon as they fit.

    An image that fits only alone is admitted alone, if necessary with less memory for the devices.
    An image that does not fit even then is rejected.

    Args:
        size: bytes that images in flight may take together. None is no limit.
        devices: the devices that develop them. The memory limits of devices that share this
            machine's memory count as taken.
        drop: frees arrays that are kept for later images.
        left: returns the memory that this process may still take. None asks the system.
    """

    def __init__(
        self,
        size: int | None,
        devices: Sequence[Device | None] = (),
        drop: Callable[[], None] = lambda: None,
        left: Callable[[], FreeMemory | None] | None = None,
    ) -> None:
        self._size = size
        self._sharing = [each for each in devices if each and each.info.zero_copy]
        has_staged = any(each and not each.info.zero_copy for each in devices)
        self._staging = size or 0 if has_staged else 0  # bytes; staging buffers of GPUs
        self._compiling = len(devices)
        self._drop = drop
        self._left = left or free_memory
        self._max_free = 0  # the most bytes that were ever free for one image and the devices
        self._measured: tuple[float, FreeMemory | None] = 0.0, FreeMemory(0, "")
        self._taken: dict[Lease, int] = {}  # bytes
        # Lets one image wait at a time, so that no image overtakes it.
        self._queue = threading.Lock()
        # Guards the attributes above, and is notified when one changes.
        self._changed = threading.Condition()
        self._is_closed = False

    def acquire(self, size: int) -> Lease:
        """Wait until an image of ``size`` bytes fits, and take its memory.

        Raises:
            ImageError: the image does not fit even alone, or the run has ended.
        """
        with self._queue, self._changed:
            self._changed.wait_for(lambda: self._is_closed or self._fits(size) or self._is_alone)
            if self._is_closed:
                raise ImageError("the run ended before this image was started")
            lease = Lease(self, size)
            if not self._fits(size):
                self._shrink_devices(lease)
            self._taken[lease] = size
            return lease

    def fits(self, size: int) -> bool:
        """Return whether an image of ``size`` bytes fits now."""
        with self._changed:
            return self._fits(size)

    def take_back(self, lease: Lease) -> None:
        """Do the work of :meth:`Lease.release`."""
        with self._changed:
            self._taken.pop(lease, None)
            _restore(lease)
            self._changed.notify_all()

    def device_ready(self) -> None:
        """Note that a device has compiled its kernels, or has failed to."""
        with self._changed:
            self._compiling -= 1
            self._changed.notify_all()

    def close(self) -> None:
        """End the run: reject images that wait or arrive later."""
        with self._changed:
            self._is_closed = True
            self._changed.notify_all()

    @property
    def _is_alone(self) -> bool:
        return not self._taken and self._compiling <= 0

    def _fits(self, size: int) -> bool:
        """Return whether an image fits: into the free memory, and with others into the budget."""
        total = sum(self._taken.values()) + size
        if self._size is not None and self._taken and total > self._size:
            return False
        free = self._free(size)
        return free is None or needed(size) <= free.bytes

    def _free(self, size: int) -> FreeMemory | None:
        """Return the memory for one more image. Small images may use a recent measurement."""
        when, free = self._measured
        now = time.monotonic()
        if free is None or now - when > MEASUREMENT_SECONDS or needed(size) > free.bytes // 32:
            free = self._left()
            if free is not None:
                remaining = free.bytes - self._staging - COMPILE_MEMORY * (self._compiling > 0)
                allocated = sum(each.bytes_held for each in self._sharing)
                self._max_free = max(self._max_free, remaining + allocated)
                growth = sum(max(each.memory - each.bytes_held, 0) for each in self._sharing)
                free = replace(free, bytes=max(remaining - growth, 0))
            self._measured = now, free
        return free

    def _shrink_devices(self, lease: Lease) -> None:
        """Reduce the memory of devices for a single image. No device is working at that time.

        Raises:
            ImageError: there is not enough memory.
        """
        size = lease.size
        self._drop()
        trim_memory()
        free = self._free(size)
        # A small image needs less device memory, because its planes are smaller.
        min_memory = min(MIN_DEVICE_MEMORY, 4 * size + UNCOUNTED // 2)
        possible = self._max_free - sum(min(each.memory, min_memory) for each in self._sharing)
        if needed(size) <= possible:
            for device in self._sharing:
                if device.memory > min_memory:
                    lease.limits[device] = device.memory
                    device.limit_memory(min_memory)
            deadline = time.monotonic() + WAIT_SECONDS
            while not (fits := self._fits(size)) and time.monotonic() < deadline:
                time.sleep(WAIT_SECONDS / 20)
            if fits:
                return
            free = self._free(size)
            possible = free.bytes if free else 0
            _restore(lease)
        left = format_bytes(max(possible, 0))
        raise MemoryLimitError(
            f"it takes about {format_bytes(needed(size))} of memory, but only {left} "
            f"is available ({free.limit if free else 'this machine'}); allow more memory, "
            "or use less with --jobs 1 or fewer pictures per image"
        )


def _restore(lease: Lease) -> None:
    """Restore the memory limits of devices that were lowered for an image."""
    for device, memory in lease.limits.items():
        device.memory = memory
    lease.limits.clear()


def needed(size: int) -> int:
    """Return how many bytes must be free for an image that takes ``size`` bytes."""
    return size + size // 8 + UNCOUNTED
