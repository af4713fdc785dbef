"""Whole files: their digest, and writing them so that none is ever left half-written."""

import contextlib
import hashlib
import os
import secrets
import shutil
import threading
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO

from clpipe.base.cpu_time import CpuTimer
from clpipe.base.errors import ImageError
from clpipe.base.reading import check_regular
from clpipe.base.system import bring_to_disk


@CpuTimer("hash")
def sha256_of(path: Path) -> tuple[str, int]:
    """The SHA-256 of a file, and its size in bytes.

    Raises:
        OSError: it cannot be read, or is no regular file.
    """
    check_regular(path)
    with open(path, "rb", buffering=0) as file:
        return hashlib.file_digest(file, "sha256").hexdigest(), file.tell()


@dataclass(frozen=True)
class Stored:
    """A file as it was written: its size in bytes, and its SHA-256."""

    size: int
    sha256: str


_unfinished: set[Path] = set()  # temporary files of this process, for `remove_temporary_files`

LONGEST = 200  # bytes of a name that its temporary name repeats; file systems hold 255


def shortened(name: str) -> str:
    """A name as far as a temporary name repeats it.

    >>> shortened("render"), len(shortened("x" * 255))
    ('render', 200)
    """
    while len(os.fsencode(name)) > LONGEST:
        name = name[:-1]
    return name


_passing = threading.local()  # has "files" in a thread that writes passing files


@contextlib.contextmanager
def passing_files() -> Iterator[None]:
    """Files that this thread writes inside need not outlive a loss of power, which saves time."""
    _passing.files = True
    try:
        yield
    finally:
        del _passing.files


@contextlib.contextmanager
def whole_file(path: Path) -> Iterator[BinaryIO]:
    """A file to write to, which takes the place of ``path`` when all of it is on the disk.

    It is new, so it follows no link. Where it cannot be written, or the body raises, ``path`` stays
    as it was. See :func:`passing_files`, too.

    Raises:
        ImageError: the file cannot be written.
    """
    beside = path.with_name(f".{shortened(path.stem)}.{secrets.token_hex(4)}.part{path.suffix}")
    _unfinished.add(beside)
    try:
        with open(beside, "xb") as file:
            yield file
            file.flush()
            if not hasattr(_passing, "files"):
                os.fsync(file.fileno())  # else a loss of power leaves an empty file under its name
        beside.replace(path)
    except OSError as error:
        raise ImageError(f"{path}: cannot be written: {error.strerror or error}") from None
    finally:
        with contextlib.suppress(OSError):
            beside.unlink(missing_ok=True)
        _unfinished.discard(beside)


@CpuTimer("write")
def write_whole(path: Path, *parts: bytes | memoryview) -> Stored:
    """Write a file, all of it or nothing; an existing one is replaced.

    Args:
        path: the file.
        *parts: its bytes, one behind the other; views are of bytes.

    Raises:
        ImageError: the file cannot be written.
    """
    digest, size = hashlib.sha256(), 0
    with whole_file(path) as file:
        for part in parts:
            file.write(part)
            with CpuTimer("hash"):
                digest.update(part)
            size += len(part)
    return Stored(size, digest.hexdigest())


def make_folder_of(path: Path) -> None:
    """Make the folders above a file that is to be written, where they are missing.

    Raises:
        ImageError: they cannot be made.
    """
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise ImageError(f"{path}: cannot be written: {error.strerror}") from None


def write_new(path: Path, data: bytes) -> Stored:
    """Make the folders above a file where they are missing, then :func:`write_whole`.

    Raises:
        ImageError: the file cannot be written.
    """
    make_folder_of(path)
    return write_whole(path, data)


def discard(path: Path) -> None:
    """Remove a file, or a folder and all in it; what cannot be removed stays."""
    with contextlib.suppress(OSError):
        if path.is_dir() and not path.is_symlink():
            shutil.rmtree(path)
        else:
            path.unlink()


def keep_names(folder: Path) -> None:
    """Have the names of a folder outlive a loss of power, as far as its file system can."""
    if hasattr(_passing, "files"):
        return
    with contextlib.suppress(OSError):
        bring_to_disk(folder)


def remove_temporary_files() -> None:
    """Delete the temporary files that are being written now; call it just before exiting."""
    for path in list(_unfinished):
        with contextlib.suppress(OSError):
            path.unlink(missing_ok=True)
