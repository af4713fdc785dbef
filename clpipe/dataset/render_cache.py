"""A cache of decoded renders that all workers of a dataset share."""

import os
import pickle
import shutil
import tempfile
import weakref
from collections.abc import Callable, Hashable
from contextlib import suppress
from dataclasses import replace
from hashlib import blake2b
from pathlib import Path

import numpy as np

from clpipe.base.errors import ImageError, RequestError
from clpipe.base.files import atomic_file, unsynced_files
from clpipe.base.process_folder import process_folder
from clpipe.base.system import lock_file
from clpipe.engine.buffers import is_planar
from clpipe.images.read import SourceImage

MAX_OPEN = 4096  # files that a process maps at a time
TOTAL = "total"  # a file with the bytes of all pixels, so that a miss need not list the others


class RenderCache:
    """Decoded renders in files that every process maps into its memory.

    Each worker of a ``DataLoader`` gets a copy of the dataset with the path of the cache. Workers
    share decoded renders, whose pages are in memory once. When the files take ``size`` bytes,
    further renders are decoded each time. The cache is a temporary directory of the process that
    created it, and is removed with the dataset. If the process is killed, a later one removes it.

    Args:
        size: the bytes of all files. 0 keeps none.

    Raises:
        RequestError: the temporary directory cannot be created.

    >>> image = SourceImage(np.ones((2, 3, 3), np.float16), "", "", (), {})
    >>> renders = RenderCache(100)
    >>> [renders.get(key, lambda: image).pixels.shape for key in "aabc"], renders.size_in_bytes
    ([(2, 3, 3), (2, 3, 3), (2, 3, 3), (2, 3, 3)], 72)
    """

    def __init__(self, size: int) -> None:
        self._size = size
        self._folder: Path | None = None
        self._opened: dict[Hashable, SourceImage] = {}
        if size:
            if not (place := process_folder()):
                raise RequestError(
                    "cache: the temporary directory for decoded renders cannot be created. Set "
                    "TMPDIR to a writable directory with free space, or cache=0"
                )
            self._folder = Path(tempfile.mkdtemp(prefix="renders-", dir=place))
            np.zeros(1, np.int64).tofile(self._folder / TOTAL)
            weakref.finalize(self, _remove, self._folder, os.getpid())

    def __reduce__(self) -> tuple[object, ...]:
        return _reopen, (self._size, self._folder)

    @property
    def size_in_bytes(self) -> int:
        """The bytes of all pixels in the cache."""
        return int(np.fromfile(self._folder / TOTAL, np.int64)[0]) if self._folder else 0

    def _add(self, size: int) -> bool:
        """Add bytes to the total, and return whether they fit."""
        assert self._folder
        with open(self._folder / TOTAL, "r+b") as file:
            lock_file(file.fileno(), exclusive=True)
            total = int(np.fromfile(file, np.int64)[0]) + size
            if total > self._size:
                return False
            file.seek(0)
            file.write(np.int64(total).tobytes())
        return True

    def _store(self, path: Path, source: SourceImage) -> None:
        """Write a render to a path in the cache, if it fits and no process has begun to."""
        if source.pixels.nbytes > self._size - self.size_in_bytes:
            return
        marker = path.with_suffix(".begun")
        try:
            marker.touch(exist_ok=False)
        except OSError:
            return
        if not self._add(source.pixels.nbytes):
            marker.unlink()
        elif not _write(path, source):
            self._add(-source.pixels.nbytes)
            marker.unlink()

    def get(self, key: Hashable, decode: Callable[[], SourceImage]) -> SourceImage:
        """Return a render.

        Args:
            key: identifies the render, with the size and modification time of its file.
            decode: decodes a render that is not in the cache.
        """
        if not self._folder:
            return decode()
        if key in self._opened:
            return self._opened[key]
        name = blake2b(repr(key).encode("utf-8", "surrogatepass"), digest_size=16).hexdigest()
        path = self._folder / name
        if (opened := _open_mapped(path)) is None:
            source = decode()
            with suppress(OSError):  # another program may remove temporary files
                self._store(path, source)
            opened = _open_mapped(path)
            if opened is None:
                return source
        if len(self._opened) >= MAX_OPEN:
            self._opened.clear()
        self._opened[key] = opened
        return opened


def _open_mapped(path: Path) -> SourceImage | None:
    """Return the render at a path in the cache, memory-mapped, or None."""
    try:
        with path.with_suffix(".pickle").open("rb") as file:
            source, planar = pickle.load(file)  # noqa: S301  # written by this user
        pixels = np.asarray(np.load(path.with_suffix(".npy"), mmap_mode="r"))
    except (OSError, ValueError, EOFError, pickle.UnpicklingError):
        return None  # missing, or cut off because the disk was full
    except SystemError:
        return None  # Python 3.11 before 3.11.8 parses headers wrongly in threads (gh-106905)
    return replace(source, pixels=pixels.transpose(1, 2, 0) if planar else pixels)


def _write(path: Path, source: SourceImage) -> bool:
    """Write a render to a path in the cache, and return whether this succeeded."""
    planar, pixels = is_planar(source.pixels), source.pixels
    without_pixels = replace(
        source, pixels=np.broadcast_to(pixels[:1, :1], (1, 1, *pixels.shape[2:]))
    )
    try:
        with unsynced_files():
            with atomic_file(path.with_suffix(".npy")) as file:
                np.save(file, pixels.transpose(2, 0, 1) if planar else pixels)
            # Written last, so that the .npy file is complete if this file exists.
            with atomic_file(path.with_suffix(".pickle")) as file:
                pickle.dump((without_pixels, planar), file)
    except (ImageError, OSError):
        return False
    return True


def _reopen(size: int, folder: Path | None) -> RenderCache:
    """Return the cache of another process, or a new one if it is on another machine."""
    renders = RenderCache(0 if folder and folder.is_dir() else size)
    if folder and not renders._folder:
        renders._size, renders._folder = size, folder
    return renders


def _remove(folder: Path, process: int) -> None:
    if os.getpid() == process:
        shutil.rmtree(folder, ignore_errors=True)
