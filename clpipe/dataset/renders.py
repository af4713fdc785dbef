"""Decoded renders, kept for further patches and epochs, which all workers of a dataset share."""

import os
import pickle
import shutil
import tempfile
import weakref
from collections.abc import Callable, Hashable
from dataclasses import replace
from hashlib import blake2b
from pathlib import Path

import numpy as np

from clpipe.base.errors import ImageError, RequestError
from clpipe.base.files import passing_files, whole_file
from clpipe.engine.runner import is_planar
from clpipe.images.read import SourceImage

OPEN = 4096  # files that a process has mapped at a time


class SharedRenders:
    """Renders as they were decoded, in files that every process maps into its memory.

    Workers of a ``DataLoader`` each get a copy of the dataset, and with it the folder's name. A
    render that one of them has decoded, the others read; its pages are in memory once. Files are
    kept until they take ``size`` bytes together; further renders are decoded each time. The folder
    is among the system's temporary files. It belongs to the process that made it, and is removed
    with the dataset there.

    Args:
        size: bytes that all of them may take; 0 keeps none.

    Raises:
        RequestError: no temporary folder can be made.

    >>> image = SourceImage(np.ones((2, 3, 3), np.float16), "", "", (), {})
    >>> renders = SharedRenders(100)
    >>> [renders.get(key, lambda: image).pixels.shape for key in "aabc"], renders.taken
    ([(2, 3, 3), (2, 3, 3), (2, 3, 3), (2, 3, 3)], 72)
    """

    def __init__(self, size: int) -> None:
        self._size = size
        self._folder: Path | None = None
        self._opened: dict[Hashable, SourceImage] = {}
        if size:
            try:
                self._folder = Path(tempfile.mkdtemp(prefix="clpipe-renders-"))
            except OSError as error:
                raise RequestError(
                    f"cache: decoded renders are kept in a temporary folder, but none can be made "
                    f"({error.strerror}); set TMPDIR to a folder that can be written, or cache=0"
                ) from None
            weakref.finalize(self, _remove, self._folder, os.getpid())

    def __reduce__(self) -> tuple[object, ...]:
        return _shared, (self._size, self._folder)

    @property
    def taken(self) -> int:
        """The bytes of all samples that are kept."""
        # Those without a dot, which are whole.
        files = list(self._folder.glob("[!.]*.npy")) if self._folder else []
        return sum(file.stat().st_size - HEADER for file in files)

    def get(self, key: Hashable, decode: Callable[[], SourceImage]) -> SourceImage:
        """Return a render.

        Args:
            key: what the render follows from, with its file's size and time of change.
            decode: decodes it, where nobody has yet.
        """
        if not self._folder:
            return decode()
        if key in self._opened:
            return self._opened[key]
        name = blake2b(repr(key).encode("utf-8", "surrogatepass"), digest_size=16).hexdigest()
        place = self._folder / name
        if (mapped := _mapped(place)) is None:
            source = decode()
            if self.taken + source.pixels.nbytes > self._size or not _keep(place, source):
                return source
            mapped = _mapped(place) or source
        if len(self._opened) >= OPEN:
            self._opened.clear()
        self._opened[key] = mapped
        return mapped


HEADER = 128  # bytes, of NumPy's files


def _mapped(place: Path) -> SourceImage | None:
    """The render that is kept in a place, if one is."""
    try:
        with place.with_suffix(".pickle").open("rb") as file:
            source, planar = pickle.load(file)  # noqa: S301  # that a process of this user made
        pixels = np.asarray(np.load(place.with_suffix(".npy"), mmap_mode="r"))
    except OSError:
        return None
    return replace(source, pixels=pixels.transpose(1, 2, 0) if planar else pixels)


def _keep(place: Path, source: SourceImage) -> bool:
    """Keep a render in a place; whether that worked."""
    planar, pixels = is_planar(source.pixels), source.pixels
    rest = replace(source, pixels=np.broadcast_to(pixels[:1, :1], (1, 1, *pixels.shape[2:])))
    try:
        with passing_files():
            with whole_file(place.with_suffix(".npy")) as file:
                np.save(file, pixels.transpose(2, 0, 1) if planar else pixels)
            with whole_file(place.with_suffix(".pickle")) as file:  # last: the other one is whole
                pickle.dump((rest, planar), file)
    except (ImageError, OSError):
        return False
    return True


def _shared(size: int, folder: Path | None) -> SharedRenders:
    """The renders of another process; its own where the folder is not on this machine."""
    renders = SharedRenders(0 if folder and folder.is_dir() else size)
    if folder and not renders._folder:
        renders._size, renders._folder = size, folder
    return renders


def _remove(folder: Path, process: int) -> None:
    if os.getpid() == process:
        shutil.rmtree(folder, ignore_errors=True)
