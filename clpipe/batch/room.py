"""How many images fit into this machine's memory at a time."""

import threading
from collections.abc import Sequence

from clpipe.base.digests import stamp_of
from clpipe.base.memory import available_memory
from clpipe.chain.formats import DNG, FORMATS
from clpipe.images.openimageio import claimed_pixels
from clpipe.images.raw import RAW_SUFFIXES
from clpipe.inputs.find import Job

FLOATS = 12  # bytes of a pixel in three floats


def usual_room(sharing: int = 1) -> int | None:
    """Bytes that images in flight may take: half of what is free; the rest is for devices.

    ``sharing`` is how many processes do the same. None where the system does not say what is free.
    """
    free = available_memory()
    return None if free is None else free // 2 // sharing


def host_bytes(
    job: Job, renditions: int, formats: Sequence[str], keep: Sequence[str], carried: int = 0
) -> int:
    """About how many bytes an image takes while it is in flight, by its file's header.

    Args:
        job: the image; of a file that is no picture to OpenImageIO, each byte is taken for a pixel,
            which is more than raws and dumps have.
        renditions: how many results there may be of it at a time.
        formats: of the last image, and of the raw.
        keep: steps whose image is written, too.
        carried: how many layers go along with it, before and after they are moved; depth, as it is
            read and as kernels take it, is one more.
    """
    is_raw = job.path.suffix.lower() in RAW_SUFFIXES
    pixels = None if is_raw else claimed_pixels(job.path)
    if pixels is None:
        pixels = stamp_of(job.path)[0]
    deep = DNG in formats or any(FORMATS[name].bits > 8 for name in formats if name != DNG)
    result = 3 + FLOATS * (len(keep) + deep)
    averaging = FLOATS if job.subframes else 0
    return pixels * (FLOATS + averaging + result * renditions + 2 * FLOATS * carried)


class Room:
    """Lets images in while they fit, in the order in which they come; one always does.

    Args:
        size: bytes; None is no limit.
    """

    def __init__(self, size: int | None) -> None:
        self._size = size
        self._taken: dict[str, int] = {}  # bytes, by the name of an image
        self._queue = threading.Lock()
        self._changed = threading.Condition()
        self._is_open = False

    def enter(self, name: str, size: int) -> None:
        """Take the room for an image, and wait until it is there."""
        with self._queue, self._changed:  # a large one is not passed by small ones for ever
            self._changed.wait_for(lambda: self._fits(size))
            self._taken[name] = size

    def leave(self, name: str) -> None:
        """Give back the room of an image, where it has any."""
        with self._changed:
            self._taken.pop(name, None)
            self._changed.notify_all()

    def open(self) -> None:
        """Let everything in that waits: nothing is to follow."""
        with self._changed:
            self._is_open = True
            self._changed.notify_all()

    def _fits(self, size: int) -> bool:
        free = self._is_open or not self._taken or self._size is None
        return free or sum(self._taken.values()) + size <= (self._size or 0)
