"""Digests of files, and atomic writes: no file is ever left half-written."""

import contextlib
import hashlib
import os
import secrets
import shutil
import threading
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO

from clpipe.base.cpu_time import CpuTimer
from clpipe.base.errors import ImageError, RequestError
from clpipe.base.reading import check_regular
from clpipe.base.system import start_writeback, sync_file, sync_folder_entries


@CpuTimer("hash")
def sha256_of(path: Path) -> tuple[str, int]:
    """Return the SHA-256 of a file, and its size in bytes.

    Raises:
        OSError: the file cannot be read, or is not a regular file.
    """
    check_regular(path)
    with open(path, "rb", buffering=0) as file:
        return hashlib.file_digest(file, "sha256").hexdigest(), file.tell()


@dataclass(frozen=True)
class Stored:
    """The size in bytes and the SHA-256 of a file that was written."""

    size: int
    sha256: str


_unfinished: set[Path] = set()  # temporary files of this process, for `remove_temporary_files`
# Guards the creation of a temporary file together with its entry in _unfinished. It is reentrant,
# because a signal handler may acquire it while its own thread holds it.
_creation_lock = threading.RLock()

# A temporary name repeats at most this many bytes of a name; file systems allow 255.
MAX_NAME_BYTES = 200


def shorten_name(name: str) -> str:
    """Return the first :data:`MAX_NAME_BYTES` bytes of a name, for a temporary name.

    >>> shorten_name("render"), len(shorten_name("x" * 255))
    ('render', 200)
    """
    while len(os.fsencode(name)) > MAX_NAME_BYTES:
        name = name[:-1]
    return name


class FileGroup:
    """Files that are written under temporary names, and later synchronised and renamed together.

    The last file confirms that the others are complete, like the sidecar of an image.

    Attributes:
        paths: the final names, in the order in which the files were written.
    """

    def __init__(self) -> None:
        self.paths: list[Path] = []
        self._temporary_paths: list[Path] = []
        self._folders: set[Path] = set()

    def add(self, temporary: Path, path: Path) -> None:
        """Add a written file, with its temporary and its final name."""
        self._temporary_paths.append(temporary)
        self.paths.append(path)

    def add_folder(self, folder: Path) -> None:
        """Add a folder whose entries must also survive a power failure."""
        self._folders.add(folder)

    def discard(self) -> None:
        """Remove the files."""
        for temporary in self._temporary_paths:
            discard(temporary)
            _unfinished.discard(temporary)

    def _sync(self) -> None:
        for temporary, path in zip(self._temporary_paths, self.paths, strict=True):
            with _write_errors(path):
                sync_file(temporary)

    def _rename(self) -> None:
        last = len(self.paths) - 1
        for number, (temporary, path) in enumerate(
            zip(self._temporary_paths, self.paths, strict=True)
        ):
            with _write_errors(path):
                if number == last:
                    os.utime(temporary)  # makes the file newer than the files that it describes
                temporary.replace(path)
            _unfinished.discard(temporary)

    @staticmethod
    @CpuTimer("write")
    def commit(groups: Sequence["FileGroup"]) -> list[ImageError | None]:
        """Synchronise groups to the disk, and rename their files to the final names.

        After a power failure, each file is the complete old or the complete new one. The last file
        of a group gets its name only after all others. Many groups together take little more time
        than one, because the disk combines their writes.

        Returns:
            For each group, the error or None. After an error, the files of the group that still
            have temporary names are removed.
        """
        for group in groups:
            for temporary in group._temporary_paths:
                start_writeback(temporary)
        errors: list[ImageError | None] = []
        folders: dict[Path, None] = {}
        for number, group in enumerate(groups):
            try:
                group._sync()
                group._rename()
                folders |= dict.fromkeys(group._folders)
                errors.append(None)
            except ImageError as error:
                group.discard()
                errors.append(error)
            except BaseException:  # an unexpected error ends the loop
                for unfinished in groups[number:]:
                    unfinished.discard()
                raise
        for folder in folders:
            sync_folder(folder)
        return errors


_thread = threading.local()  # "group": the group of deferred files, or None for passing files


@contextlib.contextmanager
def deferred_files() -> Iterator[FileGroup]:
    """Write this thread's files under temporary names until the group is committed.

    If the body raises an error, the files are removed.
    """
    group = FileGroup()
    with _file_group(group):
        try:
            yield group
        except BaseException:
            group.discard()
            raise


@contextlib.contextmanager
def unsynced_files() -> Iterator[None]:
    """Do not synchronise this thread's files to the disk: a power failure may lose them."""
    with _file_group(None):
        yield


@contextlib.contextmanager
def _file_group(group: FileGroup | None) -> Iterator[None]:
    before = vars(_thread).copy()
    _thread.group = group
    try:
        yield
    finally:
        vars(_thread).clear()
        vars(_thread).update(before)


@contextlib.contextmanager
def _write_errors(path: Path) -> Iterator[None]:
    """Raise an OSError of the ``with`` block as an ImageError about a file."""
    try:
        yield
    except OSError as error:
        raise ImageError(f"{path}: cannot be written: {error.strerror or error}") from None


def _create_temporary(temporary: Path) -> BinaryIO:
    """Create and open a temporary file."""
    with _creation_lock:
        _unfinished.add(temporary)
        return open(temporary, "xb")


@contextlib.contextmanager
def atomic_file(path: Path, stem: str = "") -> Iterator[BinaryIO]:
    """Open a new file that replaces ``path`` when all of it is on the disk.

    The temporary name begins with a stem, which is that of ``path`` unless another one is passed.
    Links are not followed. If the file cannot be written, or the body raises, ``path`` does not
    change. See also :func:`unsynced_files` and :func:`deferred_files`.

    Raises:
        ImageError: the file cannot be written.
    """
    temporary = path.with_name(
        f".{shorten_name(stem or path.stem)}.{secrets.token_hex(4)}.part{path.suffix}"
    )
    is_written = False
    try:
        with _write_errors(path):
            with _create_temporary(temporary) as file:
                yield file
                file.flush()
                if not hasattr(_thread, "group"):
                    os.fsync(file.fileno())  # otherwise a power failure can leave an empty file
            if group := getattr(_thread, "group", None):
                group.add(temporary, path)
            else:
                temporary.replace(path)
                _unfinished.discard(temporary)
        is_written = True
    finally:
        if not is_written:
            discard(temporary)
            _unfinished.discard(temporary)


@CpuTimer("write")
def write_atomic(path: Path, *parts: bytes | memoryview) -> Stored:
    """Write a file completely or not at all. An existing file is replaced.

    Args:
        path: the file.
        *parts: its bytes, in order. The items of a memoryview must be bytes.

    Raises:
        ImageError: the file cannot be written.
    """
    digest, size = hashlib.sha256(), 0
    with atomic_file(path) as file:
        for part in parts:
            file.write(part)
            with CpuTimer("hash"):
                digest.update(part)
            size += len(part)
    return Stored(size, digest.hexdigest())


def check_suffix(option: str, path: Path, *suffixes: str) -> None:
    """Check that the name of a file to write ends in one of some suffixes.

    Raises:
        RequestError: it does not.
    """
    if path.suffix not in suffixes:
        expected = f"expected a name that ends in {', '.join(suffixes)}"
        raise RequestError(f"{option}: found {path}; {expected}")


def check_folder(folder: Path) -> None:
    """Check that neither an output directory nor one of its parents is an existing file.

    Raises:
        RequestError: one is a file.
    """
    if file := _file_in_path(folder):
        raise RequestError(f"--output: {file} is a file. Name an output directory.")


def _file_in_path(folder: Path) -> Path | None:
    return next((place for place in (folder, *folder.parents) if os.path.isfile(place)), None)


def create_parents(path: Path) -> None:
    """Create the missing parent folders of a file.

    Raises:
        ImageError: a folder cannot be created.
    """
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        file = _file_in_path(path.parent)
        reason = f"{file} is a file, not a folder" if file else error.strerror
        raise ImageError(f"{path}: cannot be written: {reason}") from None


def write_new(path: Path, data: bytes) -> Stored:
    """Create the missing parent folders of a file, then write it with :func:`write_atomic`.

    Raises:
        ImageError: the file cannot be written.
    """
    create_parents(path)
    return write_atomic(path, data)


def discard(path: Path) -> None:
    """Remove a file, or a folder with its contents. Errors are ignored."""
    with contextlib.suppress(OSError):
        if path.is_dir() and not path.is_symlink():
            shutil.rmtree(path)
        else:
            path.unlink()


def sync_folder(folder: Path, immediately: bool = False) -> None:
    """Synchronise the entries of a folder to the disk, if its file system can.

    Args:
        folder: the folder.
        immediately: whether to do so now even if files are deferred, see :func:`deferred_files`.
    """
    if hasattr(_thread, "group") and not (_thread.group and immediately):
        if _thread.group:
            _thread.group.add_folder(folder)
        return
    with contextlib.suppress(OSError):
        sync_folder_entries(folder)


def remove_temporary_files() -> None:
    """Remove the unfinished temporary files. Call this just before the process exits.

    Afterwards, a thread that creates a temporary file blocks until the process ends.
    """
    _creation_lock.acquire()
    for path in list(_unfinished):
        with contextlib.suppress(OSError):
            path.unlink(missing_ok=True)
