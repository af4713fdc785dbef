"""How many images fit into this machine's memory at a time, and which one never does."""

import threading
import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from math import prod

from clpipe.base.errors import ImageError
from clpipe.base.memory import Left, available_memory, in_words, memory_left
from clpipe.base.system import give_back_memory
from clpipe.chain.chain import Chain
from clpipe.chain.formats import DNG, FORMATS
from clpipe.engine.device import Device
from clpipe.images.claims import Claim

FLOATS = 12  # bytes of a pixel in three floats
IN_NUMPY = 16 * FLOATS  # of a pixel, while the chain runs in NumPy; measured: 152
ASIDE = 8 << 20  # bytes for what is not counted; and an eighth of what an image takes
STARTING = 160 << 20  # bytes that compiling all kernels takes; measured: 100 to 140 MiB
LEAST = 32 << 20  # bytes of a device's buffers with which a large image still goes through in tiles
PATIENCE = 1.0  # s; what an image took before is freed a little after it is reported
LASTS = 0.1  # s for which a measurement of memory holds; it takes 0.4 ms, a small image 10


def usual_room(sharing: int = 1) -> int | None:
    """Bytes that several images may take at a time: half of what is free; the rest is for devices.

    ``sharing`` is how many processes do the same. None where the system does not say what is free.
    """
    free = available_memory()
    return None if free is None else free // 2 // sharing


def host_bytes(
    claim: Claim,
    chain: Chain,
    renditions: int,
    formats: Sequence[str],
    keep: Sequence[str],
    beside: int = 0,
    in_numpy: bool = False,
) -> int:
    """About how many bytes an image takes at most while it is in flight.

    What devices take is not in it. At 6 and 24 MP it was 1.05 to 2.7 times what was measured.

    Args:
        claim: what its file claims.
        chain: what it goes through.
        renditions: how many results there may be of it at a time.
        formats: of the last image, and of the raw.
        keep: steps whose image is written, too.
        beside: how many images of three floats there are beside it: the sum of sub-frames, and two
            of each further exposure, of that and as kernels take it, and of each layer that goes
            along, before and after it is moved, or as it is read and as kernels take it.
        in_numpy: whether NumPy develops it.

    Raises:
        ImageError: it cannot have a size in this chain.
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


class Room:
    """Lets images in while they fit, in the order in which they come.

    What fits only alone is let in alone, where need be with devices that hold little meanwhile.
    What does not fit then is refused.

    Args:
        size: bytes that several images may take at a time; None is no limit.
        devices: where they are developed. Of those that work in this machine's memory their limits
            count as taken.
        drop: gives back what is kept for later images.
        left: what this process can still take; None asks the system.
    """

    def __init__(
        self,
        size: int | None,
        devices: Sequence[Device | None] = (),
        drop: Callable[[], None] = lambda: None,
        left: Callable[[], Left | None] | None = None,
    ) -> None:
        self._size = size
        self._sharing = [each for each in devices if each and each.info.in_place]
        has_staged = any(each and not each.info.in_place for each in devices)
        self._aside = size or 0 if has_staged else 0  # for what lies between here and a GPU
        self._starting = len(devices)
        self._drop = drop
        self._left = left or memory_left
        self._limits: dict[Device, int] = {}  # of devices that hold little meanwhile
        self._most = 0  # bytes that there ever were for one image and the devices
        self._measured: tuple[float, Left | None] = 0.0, Left(0, "")
        self._taken: dict[str, int] = {}  # bytes, by the name of an image
        self._queue = threading.Lock()  # lets one image wait at a time, so none overtakes it
        self._changed = threading.Condition()  # guards all of the above; notified when they change
        self._is_open = False

    def enter(self, name: str, size: int) -> None:
        """Take the room for an image, and wait until it is there.

        Raises:
            ImageError: it does not fit, not even alone; or nothing is to follow.
        """
        with self._queue, self._changed:
            self._changed.wait_for(lambda: self._is_open or self._fits(size) or self._is_alone)
            if self._is_open:
                raise ImageError("the run ended before it was begun")
            if not self._fits(size):
                self._squeeze(size)
            self._taken[name] = size

    def fits(self, size: int) -> bool:
        """Whether there is room for an image now."""
        with self._changed:
            return self._fits(size)

    def leave(self, name: str) -> None:
        """Give back the room of an image, where it has any."""
        with self._changed:
            self._taken.pop(name, None)
            self._restore()
            self._changed.notify_all()

    def started(self) -> None:
        """Note that a device has compiled its kernels, or never will."""
        with self._changed:
            self._starting -= 1
            self._changed.notify_all()

    def open(self) -> None:
        """Let nothing wait any more: nothing is to follow."""
        with self._changed:
            self._is_open = True
            self._changed.notify_all()

    @property
    def _is_alone(self) -> bool:
        return not self._taken and self._starting <= 0

    def _fits(self, size: int) -> bool:
        """Whether an image fits now: into what is free, and beside others into the common room."""
        together = sum(self._taken.values()) + size
        if self._size is not None and self._taken and together > self._size:
            return False
        free = self._free(size)
        return free is None or needed(size) <= free.bytes

    def _free(self, size: int) -> Left | None:
        """What there is for one more image, measured anew where that matters for its size."""
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
        """Make room for an image that is alone; no device is at work then.

        Raises:
            ImageError: there is not enough.
        """
        self._drop()
        give_back_memory()
        free = self._free(size)
        least = min(LEAST, 4 * size + ASIDE // 2)  # the planes of a small image are no larger
        there = self._most - sum(min(each.memory, least) for each in self._sharing)
        if needed(size) <= there:  # or nothing helps
            for device in self._sharing:
                if device.memory > least:
                    self._limits[device] = device.memory
                    device.limit(least)
            end = time.monotonic() + PATIENCE
            while not (fits := self._fits(size)) and time.monotonic() < end:
                time.sleep(PATIENCE / 20)
            if fits:
                return
            free = self._free(size)
            there = free.bytes if free else 0
            self._restore()
        left = in_words(max(there, 0))
        raise ImageError(
            f"it takes about {in_words(needed(size))} of memory; {left} are left by "
            f"{free.by if free else 'this machine'}; allow more, or ask for less (--jobs 1, fewer "
            "pictures of each image)"
        )

    def _restore(self) -> None:
        for device, memory in self._limits.items():
            device.memory = memory
        self._limits.clear()


def needed(size: int) -> int:
    """The bytes that are to be free for an image that takes ``size``."""
    return size + size // 8 + ASIDE
