"""Whole files: their digest, and writing them so that none is ever left half-written."""

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
from clpipe.base.system import begin_writing, bring_to_disk, file_to_disk


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
# Guards the moment in which a temporary file is made and noted in _unfinished. A signal handler may
# take it although its own thread holds it.
_beginning = threading.RLock()

LONGEST = 200  # bytes of a name that its temporary name repeats; file systems hold 255


def shortened(name: str) -> str:
    """A name as far as a temporary name repeats it.

    >>> shortened("render"), len(shortened("x" * 255))
    ('render', 200)
    """
    while len(os.fsencode(name)) > LONGEST:
        name = name[:-1]
    return name


class FileGroup:
    """Files that are written, but are to be brought to the disk, and under their names, together.

    The last one says of the others that they are whole, as a sidecar of its pictures.

    Attributes:
        paths: their names to be, in the order in which they were written.
    """

    def __init__(self) -> None:
        self.paths: list[Path] = []
        self._beside: list[Path] = []
        self._folders: set[Path] = set()

    def add(self, beside: Path, path: Path) -> None:
        """Take a file that is written, under its temporary name."""
        self._beside.append(beside)
        self.paths.append(path)

    def add_folder(self, folder: Path) -> None:
        """Have a folder's names outlive a loss of power, too."""
        self._folders.add(folder)

    def discard(self) -> None:
        """Remove the files."""
        for beside in self._beside:
            discard(beside)
            _unfinished.discard(beside)

    def _bring_to_disk(self) -> None:
        for beside, path in zip(self._beside, self.paths, strict=True):
            with _named(path):
                file_to_disk(beside)

    def _rename(self) -> None:
        last = len(self.paths) - 1
        for number, (beside, path) in enumerate(zip(self._beside, self.paths, strict=True)):
            with _named(path):
                if number == last:
                    os.utime(beside)  # it is later than what it tells of
                beside.replace(path)
            _unfinished.discard(beside)

    @staticmethod
    @CpuTimer("write")
    def commit(groups: Sequence["FileGroup"]) -> list[ImageError | None]:
        """Bring groups to the disk, and give their files their names; a loss of power at any time
        leaves of each file the old one or the new one, whole, and the last of a group only behind
        all others.

        Many at a time take little more time than one: the disk orders what it is told together.

        Returns:
            For each group, why it could not be; what has no name yet is removed then.
        """
        for group in groups:
            for beside in group._beside:
                begin_writing(beside)
        errors: list[ImageError | None] = []
        folders: dict[Path, None] = {}
        for number, group in enumerate(groups):
            try:
                group._bring_to_disk()
                group._rename()
                folders |= dict.fromkeys(group._folders)
                errors.append(None)
            except ImageError as error:
                group.discard()
                errors.append(error)
            except BaseException:  # which nobody expected
                for left in groups[number:]:
                    left.discard()
                raise
        for folder in folders:
            keep_names(folder)
        return errors


_thread = threading.local()  # has "group" in a thread whose files are deferred; None is passing


@contextlib.contextmanager
def deferred_files() -> Iterator[FileGroup]:
    """Files that this thread writes inside get their names when the group is committed.

    Where the body raises, they are removed.
    """
    group = FileGroup()
    with _writing_to(group):
        try:
            yield group
        except BaseException:
            group.discard()
            raise


@contextlib.contextmanager
def passing_files() -> Iterator[None]:
    """Files that this thread writes inside need not outlive a loss of power, which saves time."""
    with _writing_to(None):
        yield


@contextlib.contextmanager
def _writing_to(group: FileGroup | None) -> Iterator[None]:
    before = vars(_thread).copy()
    _thread.group = group
    try:
        yield
    finally:
        vars(_thread).clear()
        vars(_thread).update(before)


@contextlib.contextmanager
def _named(path: Path) -> Iterator[None]:
    """Errors of the system as an ImageError about a file."""
    try:
        yield
    except OSError as error:
        raise ImageError(f"{path}: cannot be written: {error.strerror or error}") from None


def _begun(beside: Path) -> BinaryIO:
    """A new temporary file, open."""
    with _beginning:
        _unfinished.add(beside)
        return open(beside, "xb")


@contextlib.contextmanager
def whole_file(path: Path) -> Iterator[BinaryIO]:
    """A file to write to, which takes the place of ``path`` when all of it is on the disk.

    It is new, so it follows no link. Where it cannot be written, or the body raises, ``path`` stays
    as it was. See :func:`passing_files` and :func:`deferred_files`, too.

    Raises:
        ImageError: the file cannot be written.
    """
    beside = path.with_name(f".{shortened(path.stem)}.{secrets.token_hex(4)}.part{path.suffix}")
    is_written = False
    try:
        with _named(path):
            with _begun(beside) as file:
                yield file
                file.flush()
                if not hasattr(_thread, "group"):
                    os.fsync(file.fileno())  # else a loss of power leaves an empty file of its name
            if group := getattr(_thread, "group", None):
                group.add(beside, path)
            else:
                beside.replace(path)
                _unfinished.discard(beside)
        is_written = True
    finally:
        if not is_written:
            discard(beside)
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


def check_folder(folder: Path) -> None:
    """See that no file stands where a folder is to be made, or above it.

    Raises:
        RequestError: one does.
    """
    if place := _file_among(folder):
        raise RequestError(f"--output: {place} is a file; name a folder to write to")


def _file_among(folder: Path) -> Path | None:
    return next((place for place in (folder, *folder.parents) if os.path.isfile(place)), None)


def make_folder_of(path: Path) -> None:
    """Make the folders above a file that is to be written, where they are missing.

    Raises:
        ImageError: they cannot be made.
    """
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        place = _file_among(path.parent)
        reason = f"{place} is a file, not a folder" if place else error.strerror
        raise ImageError(f"{path}: cannot be written: {reason}") from None


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


def keep_names(folder: Path, at_once: bool = False) -> None:
    """Have the names of a folder outlive a loss of power, as far as its file system can.

    Args:
        folder: the folder.
        at_once: also where files are deferred, see :func:`deferred_files`.
    """
    if hasattr(_thread, "group") and not (_thread.group and at_once):
        if _thread.group:
            _thread.group.add_folder(folder)
        return
    with contextlib.suppress(OSError):
        bring_to_disk(folder)


def remove_temporary_files() -> None:
    """Delete the temporary files that are being written now; call it just before exiting.

    No other thread begins one afterwards: it waits for the end of the process.
    """
    _beginning.acquire()
    for path in list(_unfinished):
        with contextlib.suppress(OSError):
            path.unlink(missing_ok=True)
