"""The output folder: made, locked against other runs, and cleared of unfinished files."""

import contextlib
import errno
import fcntl
import os
import re
import secrets
from collections.abc import Iterable, Iterator
from pathlib import Path

from clpipe.base.errors import RequestError
from clpipe.base.files import shortened
from clpipe.base.memory import in_words
from clpipe.inputs.find import Job, Shard
from clpipe.outputs.patches import without_patch

RESUMABLE = "what is finished is there, and the same command goes on"


ROOM = 8 * 2**20  # bytes; a disk with less counts as full

LOCK = ".clpipe.lock"

PARTS = 2**40  # bytes of the lock, of which each shard holds its part; none is ever written

UNFINISHED = re.compile(r"\.(.+)\.[0-9a-f]{8}\.part\.\w+")  # as whole_file names them


def write_problem(folder: Path, with_room: bool = True) -> str:
    """Why nothing can be written to a folder, "" where it can.

    Without ``with_room`` a full disk will do, as for a run that may find all done.
    """
    probe = folder / f".clpipe.{secrets.token_hex(8)}"
    try:
        with open(probe, "xb") as file:
            if with_room:
                os.posix_fallocate(file.fileno(), 0, ROOM)
    except OSError as error:
        needed = f" ({in_words(ROOM)} are needed)" if error.errno == errno.ENOSPC else ""
        return f"cannot write there: {error.strerror}{needed}"
    finally:
        with contextlib.suppress(OSError):
            probe.unlink()
    return ""


@contextlib.contextmanager
def output_folder(folder: Path, shard: Shard) -> Iterator[None]:
    """Make the folder, see that files can be made in it, and lock it against other runs.

    Shards of one run share the lock. It is the system's, so it ends with the process.

    Raises:
        RequestError: it cannot be written to, or another run is writing there.
    """
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise RequestError(f"{folder}: cannot write there: {error.strerror}") from None
    if reason := write_problem(folder, with_room=False):
        raise RequestError(f"{folder}: {reason}")
    first = PARTS * (shard.number - 1) // shard.of
    share = PARTS * shard.number // shard.of - first
    lock = _locked(folder / LOCK, share, first)
    try:
        yield
    finally:
        # Where nobody else holds the lock, its file is of no more use.
        with contextlib.suppress(OSError):
            fcntl.lockf(lock, fcntl.LOCK_EX | fcntl.LOCK_NB, PARTS)
            (folder / LOCK).unlink()
        os.close(lock)


def _locked(path: Path, length: int, first: int) -> int:
    """Open the lock file and hold a part of it, ``length`` bytes from ``first`` on.

    Raises:
        RequestError: another process holds it.
    """
    while True:
        try:
            lock = os.open(path, os.O_RDWR | os.O_CREAT | os.O_NOFOLLOW | os.O_NONBLOCK, 0o666)
        except OSError as error:
            raise RequestError(f"{path}: cannot be locked: {error.strerror}") from None
        try:
            fcntl.lockf(lock, fcntl.LOCK_EX | fcntl.LOCK_NB, length, first)
        except OSError as error:
            if error.errno in (errno.EACCES, errno.EAGAIN):
                os.close(lock)
                raise RequestError(
                    f"{path.parent}: another run is writing there; wait for it, or choose another "
                    "output folder"
                ) from None
            return lock  # a file system without locks
        with contextlib.suppress(OSError):
            if os.fstat(lock).st_ino == path.stat().st_ino:
                return lock
        os.close(lock)  # its last holder has removed it in between


def remove_unfinished(folder: Path, jobs: Iterable[Job], patches: bool = False) -> None:
    """Remove the unfinished files that a killed run left of these jobs, or of their patches."""
    stems = {str(Path(job.stem).with_name(shortened(Path(job.stem).name))) for job in jobs}

    def is_ours(stem: str) -> bool:
        return stem in stems or (patches and without_patch(stem) in stems)

    for place, _, names in os.walk(folder):
        for match in filter(None, map(UNFINISHED.fullmatch, names)):
            stem = os.path.relpath(os.path.join(place, match[1]), folder)
            while not is_ours(stem) and "." in os.path.basename(stem):
                stem = stem.rpartition(".")[0]
            if is_ours(stem):
                with contextlib.suppress(OSError):
                    os.unlink(os.path.join(place, match[0]))
