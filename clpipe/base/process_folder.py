"""A folder that only this process uses, in which runtimes compile. It is removed at the end.

A process locks its folder, and the system releases the lock whenever the process ends. Later
processes therefore remove the folders of killed processes, but no folder in use. Programs that
clean up temporary files, like systemd-tmpfiles, also skip locked folders.
"""

import atexit
import os
import re
import shutil
import tempfile
from collections.abc import Iterator
from contextlib import suppress
from functools import cache
from pathlib import Path

from clpipe.base.files import discard
from clpipe.base.system import fcntl, forbids_programs, use, writable_by_others

ROOM = 32 * 2**20  # bytes; with less, PoCL's compiler may end the process
NAME = re.compile(r"clpipe-\d+-\w+")  # of a process's folder: its number, and random characters


@cache
def process_folder() -> Path | None:
    """Return this process's folder. The first call creates it.

    Returns:
        A folder with :data:`ROOM` bytes free, in which programs may run. None if no folder for
        temporary files allows that.
    """
    for place in temporary_places():
        with suppress(OSError):
            if has_room(place) and not forbids_programs(place):
                return _folder_in(place)
    return None


if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=process_folder.cache_clear)  # a child creates its own


def temporary_places() -> Iterator[Path]:
    """Yield the folders for temporary files, the usual one first."""
    with suppress(FileNotFoundError):
        yield Path(tempfile.gettempdir())
    yield from (place for place in (Path("/var/tmp"), Path("/dev/shm")) if place.is_dir())  # noqa: S108


def has_room(folder: Path) -> bool:
    """Return whether :data:`ROOM` bytes are free in a folder.

    Raises:
        OSError: the folder is missing or cannot be read.
    """
    return shutil.disk_usage(folder).free >= ROOM


def _folder_in(place: Path) -> Path:
    """Create a locked folder below a temporary one, and remove the folders of killed processes.

    Raises:
        OSError: the folder cannot be created.
    """
    ours = place / f"clpipe-processes-{os.getuid() if hasattr(os, 'getuid') else 'kernels'}"
    with suppress(OSError):
        ours.mkdir(mode=0o700)
    if ours.is_symlink() or not ours.is_dir() or writable_by_others(ours):
        ours = place  # another user has created it
    elif fcntl:
        for folder in ours.iterdir():
            if NAME.fullmatch(folder.name) and not folder.is_symlink():
                _remove_if_left(folder)
    while True:
        folder = Path(tempfile.mkdtemp(prefix=f"clpipe-{os.getpid()}-", dir=ours)).resolve()
        if not fcntl or _locked(folder):
            atexit.register(_remove, folder, os.getpid())
            return folder


def _locked(folder: Path) -> bool:
    """Lock a new folder until this process ends; False if another process has just removed it."""
    with suppress(FileNotFoundError):
        lock = os.open(folder, os.O_RDONLY)
        use(lock, alone=True)
        if folder.exists():
            return True
        os.close(lock)
    return False


def _remove_if_left(folder: Path) -> None:
    """Remove a folder unless a process holds its lock."""
    with suppress(OSError):
        lock = os.open(folder, os.O_RDONLY | os.O_DIRECTORY)
        try:
            if use(lock, alone=True, wait=False):
                discard(folder)
        finally:
            os.close(lock)


def _remove(folder: Path, process: int) -> None:
    if os.getpid() == process:  # a forked child also runs this
        shutil.rmtree(folder, ignore_errors=True)
