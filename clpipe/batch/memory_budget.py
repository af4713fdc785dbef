"""Admission of images by memory: how many are in flight at a time, and which never fit."""

import threading
import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from math import prod

from clpipe.base.errors import ImageError
from clpipe.base.memory import FreeMemory, available_memory, format_bytes, free_memory
from clpipe.base.system import trim_memory
from clpipe.chain.chain import Chain
from clpipe.chain.formats import DNG, FORMATS
from clpipe.engine.device import Device
from clpipe.images.claims import MemoryClaim

FLOATS = 12  # bytes of a pixel of three floats
IN_NUMPY = 16 * FLOATS  # bytes of a pixel while the chain runs in NumPy; measured: 152
ASIDE = 8 << 20  # bytes that are not counted, in addition to an eighth of an image
STARTING = 160 << 20  # bytes that compiling all kernels takes; measured: 100 to 140 MiB
LEAST = 32 << 20  # bytes of device memory that suffice for a large image in tiles
PATIENCE = 1.0  # s to wait for memory that earlier images free a little after their end
LASTS = 0.1  # s for which a measurement is used: it takes 0.4 ms, a small image 10 ms


def default_budget(sharing: int = 1) -> int | None:
    """Return the bytes that images in flight may take: half of the free memory.

    The other half is for devices. ``sharing`` is the number of processes that share the memory.
    None if the system does not report free memory.
    """
    free = available_memory()
    return None if free is None else free // 2 // sharing


def host_bytes(
    claim: MemoryClaim,
    chain: Chain,
    renditions: int,
    formats: Sequence[str],
    keep: Sequence[str],
    beside: int = 0,
    in_numpy: bool = False,
) -> int:
    """Estimate the most host memory, in bytes, that an image takes while it is in flight.

    Memory of devices is not included. At 6 and 24 MP the estimate was 1.05 to 2.7 times the
    measured memory.

    Args:
        claim: the size that its file states.
        chain: its chain.
        renditions: how many of its results exist at a time.
        formats: the formats of the last image and of the raw.
        keep: the steps whose image is also written.
        beside: the number of further images of three floats: one for the sum of sub-frames, and
            two for each further exposure and each carried layer.
        in_numpy: whether NumPy develops it.

    Raises:
        ImageError: the chain cannot process an image of this size.
    """
    pixels = claim.width * claim.height
    if not pixels:
        return 0
    deep = [FORMATS[name] for name in formats if name != DNG and FORMATS[name].bits > 8]
    kept = len(keep) + bool(deep) + (DNG in formats)
    # Encoders of integers of 16 bits compute in double precision.
    encoding = max((24 if each.floats else 36 for each in deep), default=FLOATS if kept else 1)
    size = chain.size(claim.width, claim.height)
    results = prod(size) * renditions * (3 + FLOATS * kept + encoding)
    most = max(claim.reading, claim.image + results)
    return most + pixels * (FLOATS * beside + IN_NUMPY * in_numpy)


class MemoryBudget:
    """A budget of memory: images enter in order, as soon as they fit.

    An image that fits only alone enters alone, if necessary with less memory for the devices. An
    image that does not fit even then is rejected.

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
        self._aside = size or 0 if has_staged else 0  # for staging buffers of GPUs
        self._starting = len(devices)
        self._drop = drop
        self._left = left or free_memory
        self._limits: dict[Device, int] = {}  # of devices that were given less for one image
        self._most = 0  # the most bytes that were ever free for one image and the devices
        self._measured: tuple[float, FreeMemory | None] = 0.0, FreeMemory(0, "")
        self._taken: dict[str, int] = {}  # bytes, by the stem of an image
        self._queue = threading.Lock()  # lets one image wait at a time, so none overtakes it
        self._changed = threading.Condition()  # guards all of the above; notified when they change
        self._is_closed = False

    def acquire(self, name: str, size: int) -> None:
        """Wait until an image fits, and take its memory.

        Raises:
            ImageError: it does not fit even alone, or the run has ended.
        """
        with self._queue, self._changed:
            self._changed.wait_for(lambda: self._is_closed or self._fits(size) or self._is_alone)
            if self._is_closed:
                raise ImageError("the run ended before it was begun")
            if not self._fits(size):
                self._squeeze(size)
            self._taken[name] = size

    def fits(self, size: int) -> bool:
        """Return whether an image of ``size`` bytes fits now."""
        with self._changed:
            return self._fits(size)

    def release(self, name: str) -> None:
        """Give back the memory of an image, if it has any."""
        with self._changed:
            self._taken.pop(name, None)
            self._restore()
            self._changed.notify_all()

    def device_ready(self) -> None:
        """Note that a device has compiled its kernels, or has failed to."""
        with self._changed:
            self._starting -= 1
            self._changed.notify_all()

    def close(self) -> None:
        """End the run: reject images that wait or come later."""
        with self._changed:
            self._is_closed = True
            self._changed.notify_all()

    @property
    def _is_alone(self) -> bool:
        return not self._taken and self._starting <= 0

    def _fits(self, size: int) -> bool:
        """Return whether an image fits: into the free memory, and with others into the budget."""
        together = sum(self._taken.values()) + size
        if self._size is not None and self._taken and together > self._size:
            return False
        free = self._free(size)
        return free is None or needed(size) <= free.bytes

    def _free(self, size: int) -> FreeMemory | None:
        """Return the memory for one more image. Small images may use a recent measurement."""
        when, free = self._measured
        now = time.monotonic()
        if free is None or now - when > LASTS or needed(size) > free.bytes // 32:
            free = self._left()
            if free is not None:
                rest = free.bytes - self._aside - STARTING * (self._starting > 0)
                held = sum(each.bytes_held for each in self._sharing)
                self._most = max(self._most, rest + held)
                to_come = sum(max(each.memory - each.bytes_held, 0) for each in self._sharing)
                free = replace(free, bytes=max(rest - to_come, 0))
            self._measured = now, free
        return free

    def _squeeze(self, size: int) -> None:
        """Free memory for an image that is alone. No device is working at that time.

        Raises:
            ImageError: there is not enough.
        """
        self._drop()
        trim_memory()
        free = self._free(size)
        least = min(LEAST, 4 * size + ASIDE // 2)  # the planes of a small image are no larger
        there = self._most - sum(min(each.memory, least) for each in self._sharing)
        if needed(size) <= there:
            for device in self._sharing:
                if device.memory > least:
                    self._limits[device] = device.memory
                    device.limit_memory(least)
            end = time.monotonic() + PATIENCE
            while not (fits := self._fits(size)) and time.monotonic() < end:
                time.sleep(PATIENCE / 20)
            if fits:
                return
            free = self._free(size)
            there = free.bytes if free else 0
            self._restore()
        left = format_bytes(max(there, 0))
        raise ImageError(
            f"it takes about {format_bytes(needed(size))} of memory; {left} are left by "
            f"{free.limit if free else 'this machine'}; allow more, or ask for less (--jobs 1, "
            "fewer pictures of each image)"
        )

    def _restore(self) -> None:
        for device, memory in self._limits.items():
            device.memory = memory
        self._limits.clear()


def needed(size: int) -> int:
    """Return how many bytes must be free for an image that takes ``size`` bytes."""
    return size + size // 8 + ASIDE
