"""A folder of this process alone, in which runtimes compile, and which goes with the process."""

import atexit
import os
import shutil
import tempfile
import time
from collections.abc import Iterator
from contextlib import suppress
from functools import cache
from pathlib import Path

from clpipe.base.files import discard
from clpipe.base.system import fcntl, forbids_programs, use, writable_by_others

ROOM = 32 * 2**20  # bytes; with less, PoCL's compiler may end the process
IN_USE = "in_use"  # the file that a process has alone as long as it uses its folder
YOUNG = 60.0  # s in which a folder may not have that file yet


@cache
def process_folder() -> Path | None:
    """The folder, with :data:`ROOM` and where programs may be run; None where there is none."""
    for place in temporary_places():
        with suppress(OSError):
            if has_room(place) and not forbids_programs(place):
                return _folder_in(place)
    return None


def temporary_places() -> Iterator[Path]:
    """Folders for temporary files, the usual one first."""
    with suppress(FileNotFoundError):
        yield Path(tempfile.gettempdir())
    yield from (place for place in (Path("/var/tmp"), Path("/dev/shm")) if place.is_dir())  # noqa: S108


def has_room(folder: Path) -> bool:
    """Whether there is room to compile in a folder.

    Raises:
        OSError: it cannot be looked at.
    """
    return shutil.disk_usage(folder).free >= ROOM


def _folder_in(place: Path) -> Path:
    """A new folder below one for temporary files, from which those of ended processes are removed.

    Raises:
        OSError: it cannot be made.
    """
    ours = place / f"clpipe-{os.getuid() if hasattr(os, 'getuid') else 'kernels'}"
    with suppress(OSError):
        ours.mkdir(mode=0o700)
    if ours.is_symlink() or not ours.is_dir() or writable_by_others(ours):
        ours = place  # somebody else has made it
    elif fcntl:
        for left in ours.iterdir():
            if _is_left(left):
                discard(left)
    folder = Path(tempfile.mkdtemp(prefix=f"clpipe-{os.getpid()}-", dir=ours)).resolve()
    use(os.open(folder / IN_USE, os.O_RDWR | os.O_CREAT, 0o600), alone=True, wait=False)
    atexit.register(_remove, folder, os.getpid())
    return folder


def _is_left(folder: Path) -> bool:
    """Whether the process that made a folder has ended without removing it."""
    try:
        if time.time() - folder.stat().st_mtime < YOUNG:
            return False
        lock = os.open(folder / IN_USE, os.O_RDWR)
    except FileNotFoundError:
        return True
    except OSError:
        return False
    try:
        return use(lock, alone=True, wait=False)
    finally:
        os.close(lock)


def _remove(folder: Path, process: int) -> None:
    if os.getpid() == process:  # a fork ends, too
        shutil.rmtree(folder, ignore_errors=True)
