"""The output folder: made, locked against other runs, and cleared of unfinished files."""

import contextlib
import errno
import os
import re
import secrets
from collections.abc import Iterable, Iterator
from pathlib import Path

from clpipe.base.errors import RequestError
from clpipe.base.files import shortened
from clpipe.base.memory import in_words
from clpipe.base.system import HOLDABLE, hold, let_go, open_plain, reserve
from clpipe.inputs.find import Job, Shard
from clpipe.outputs.patches import without_patch

RESUMABLE = "what is finished is there, and the same command goes on"


LEAST_FREE = 8 * 2**20  # bytes; a disk with less counts as full

LOCK = ".clpipe.lock"

UNFINISHED = re.compile(r"\.(.+)\.[0-9a-f]{8}\.part\.\w+")  # as whole_file names them

# Locks of this process: the file, its descriptor, and the first byte and the length of the part
# that is held.
_held: set[tuple[Path, int, int, int]] = set()


def write_problem(folder: Path, with_space: bool = True) -> str:
    """Why nothing can be written to a folder, "" where it can.

    Without ``with_space`` a full disk will do, as for a run that may find all done.
    """
    probe = folder / f".clpipe.{secrets.token_hex(8)}"
    try:
        with open(probe, "xb") as file:
            if with_space:
                reserve(file, LEAST_FREE)
    except OSError as error:
        needed = f" ({in_words(LEAST_FREE)} are needed)" if error.errno == errno.ENOSPC else ""
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
    if reason := write_problem(folder, with_space=False):
        raise RequestError(f"{folder}: {reason}")
    # Each shard holds its part of a file in which nothing is ever written.
    first = HOLDABLE * (shard.number - 1) // shard.of
    share = HOLDABLE * shard.number // shard.of - first
    held = folder / LOCK, _locked(folder / LOCK, share, first), first, share
    _held.add(held)
    try:
        yield
    finally:
        _held.discard(held)
        let_go(*held)


def release_folders() -> None:
    """Remove the lock files that no other process holds; call it just before exiting.

    It is for an exit that skips the end of :func:`output_folder`. A signal handler may call it.
    """
    while _held:
        with contextlib.suppress(OSError):
            let_go(*_held.pop())


def _locked(path: Path, length: int, first: int) -> int:
    """Open the lock file and hold a part of it, ``length`` bytes from ``first`` on.

    Raises:
        RequestError: another process holds it.
    """
    while True:
        try:
            lock = open_plain(path, os.O_RDWR | os.O_CREAT)
        except OSError as error:
            raise RequestError(f"{path}: cannot be locked: {error.strerror}") from None
        try:
            is_ours = hold(lock, first, length)
        except OSError:
            return lock  # a file system without locks
        if not is_ours:
            os.close(lock)
            raise RequestError(
                f"{path.parent}: another run is writing there; wait for it, or choose another "
                "output folder"
            )
        with contextlib.suppress(OSError):
            if os.fstat(lock).st_ino == path.stat().st_ino:
                return lock
        os.close(lock)  # its last holder has removed it in between


def remove_unfinished(folder: Path, jobs: Iterable[Job], patches: bool = False) -> None:
    """Remove the unfinished files that a killed run left of these jobs, or of their patches."""
    named = (os.path.split(job.stem) for job in jobs)
    stems = {os.path.join(folder, shortened(name)) for folder, name in named}

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
