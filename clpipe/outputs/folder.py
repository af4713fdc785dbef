"""The output directory: created, locked against other runs, and cleared of unfinished files."""

import contextlib
import errno
import os
import re
import secrets
from collections.abc import Iterable, Iterator
from pathlib import Path

from clpipe.base.errors import RequestError
from clpipe.base.files import shorten_name
from clpipe.base.memory import format_bytes
from clpipe.base.system import LOCKABLE_BYTES, close_and_remove, lock_range, open_plain, reserve
from clpipe.inputs.find import Shard
from clpipe.inputs.jobs import Job
from clpipe.outputs.patches import without_patch

RESUMABLE = "finished pictures are kept, and the same command resumes"

MIN_FREE = 8 * 2**20  # bytes; a disk with less free space counts as full

LOCK = ".clpipe.lock"

UNFINISHED = re.compile(r"\.(.+)\.[0-9a-f]{8}\.part\.\w+")  # temporary files of atomic_file

# Locks of this process: the file, its descriptor, and the first byte and length of the locked part.
_locks: set[tuple[Path, int, int, int]] = set()


def write_problem(folder: Path, with_space: bool = True) -> str:
    """Return why a folder is not writable, or "" if it is.

    Without ``with_space``, a full disk is accepted, because all pictures may be finished already.
    """
    probe = folder / f".clpipe.{secrets.token_hex(8)}"
    try:
        with open(probe, "xb") as file:
            if with_space:
                reserve(file, MIN_FREE)
    except OSError as error:
        needed = f" ({format_bytes(MIN_FREE)} are needed)" if error.errno == errno.ENOSPC else ""
        return f"cannot write to this directory: {error.strerror}{needed}"
    finally:
        with contextlib.suppress(OSError):
            probe.unlink()
    return ""


@contextlib.contextmanager
def output_folder(folder: Path, shard: Shard) -> Iterator[None]:
    """Create the output directory, check that it is writable, and lock it against other runs.

    Shards of one run share the lock. The operating system releases it when the process ends.

    Raises:
        RequestError: the directory cannot be written to, or another run has locked it.
    """
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise RequestError(
            f"{folder}: this directory cannot be created: {error.strerror}; choose another output "
            "directory"
        ) from None
    if reason := write_problem(folder, with_space=False):
        raise RequestError(f"{folder}: {reason}")
    # Each shard locks its own range of this empty file.
    start = LOCKABLE_BYTES * (shard.number - 1) // shard.of
    length = LOCKABLE_BYTES * shard.number // shard.of - start
    entry = folder / LOCK, _locked(folder / LOCK, length, start), start, length
    _locks.add(entry)
    try:
        yield
    finally:
        _locks.discard(entry)
        close_and_remove(*entry)


def release_folders() -> None:
    """Remove the lock files that no other process holds. Call it just before exiting.

    An exit that skips the end of :func:`output_folder` needs this. Signal handlers may call it.
    """
    while _locks:
        with contextlib.suppress(OSError):
            close_and_remove(*_locks.pop())


def _locked(path: Path, length: int, start: int) -> int:
    """Open the lock file, lock ``length`` bytes starting at ``start``, and return its descriptor.

    Raises:
        RequestError: another process has locked that part.
    """
    while True:
        try:
            lock = open_plain(path, os.O_RDWR | os.O_CREAT)
        except OSError as error:
            raise RequestError(f"{path}: this file cannot be locked: {error.strerror}") from None
        try:
            is_ours = lock_range(lock, start, length)
        except OSError:
            return lock  # the file system does not support locks
        if not is_ours:
            os.close(lock)
            raise RequestError(
                f"{path.parent}: another run is writing to this directory; wait until it ends, or "
                "choose another output directory"
            )
        with contextlib.suppress(OSError):
            if os.fstat(lock).st_ino == path.stat().st_ino:
                return lock
        os.close(lock)  # the previous holder removed the file after it was opened


def remove_unfinished(folder: Path, jobs: Iterable[Job], patches: bool = False) -> None:
    """Remove the unfinished files of these jobs, or of their patches, that a killed run left."""
    stem_parts = (os.path.split(job.stem) for job in jobs)
    stems = {os.path.join(folder, shorten_name(name)) for folder, name in stem_parts}

    def is_of_jobs(stem: str) -> bool:
        return stem in stems or (patches and without_patch(stem) in stems)

    for parent, _, names in os.walk(folder):
        for match in filter(None, map(UNFINISHED.fullmatch, names)):
            stem = os.path.relpath(os.path.join(parent, match[1]), folder)
            while not is_of_jobs(stem) and "." in os.path.basename(stem):
                stem = stem.rpartition(".")[0]
            if is_of_jobs(stem):
                with contextlib.suppress(OSError):
                    os.unlink(os.path.join(parent, match[0]))
