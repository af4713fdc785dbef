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
from clpipe.base.system import fcntl, forbids_programs, lock_file, writable_by_others

MIN_FREE_SPACE = 32 * 2**20  # bytes; with less, PoCL's compiler may end the process
NAME = re.compile(r"clpipe-\d+-\w+")  # folder of a process: its id and random characters


@cache
def process_folder() -> Path | None:
    """Return this process's folder. The first call creates it.

    Returns:
        A folder with :data:`MIN_FREE_SPACE` bytes free, in which programs may run. None if no
        folder for temporary files allows that.
    """
    for place in temporary_folders():
        with suppress(OSError):
            if has_free_space(place) and not forbids_programs(place):
                return _create_folder(place)
    return None


if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=process_folder.cache_clear)  # a child creates its own


def temporary_folders() -> Iterator[Path]:
    """Yield the folders for temporary files, the usual one first."""
    with suppress(FileNotFoundError):
        yield Path(tempfile.gettempdir())
    yield from (place for place in (Path("/var/tmp"), Path("/dev/shm")) if place.is_dir())  # noqa: S108


def has_free_space(folder: Path) -> bool:
    """Return whether :data:`MIN_FREE_SPACE` bytes are free in a folder.

    Raises:
        OSError: the folder is missing or cannot be read.
    """
    return shutil.disk_usage(folder).free >= MIN_FREE_SPACE


def _create_folder(temporary: Path) -> Path:
    """Create a locked folder below a temporary one, and remove the folders of killed processes.

    Raises:
        OSError: the folder cannot be created.
    """
    parent = temporary / f"clpipe-processes-{os.getuid() if hasattr(os, 'getuid') else 'kernels'}"
    with suppress(OSError):
        parent.mkdir(mode=0o700)
    if parent.is_symlink() or not parent.is_dir() or writable_by_others(parent):
        parent = temporary  # another user has created the directory
    elif fcntl:
        for folder in parent.iterdir():
            if NAME.fullmatch(folder.name) and not folder.is_symlink():
                _remove_unlocked(folder)
    while True:
        folder = Path(tempfile.mkdtemp(prefix=f"clpipe-{os.getpid()}-", dir=parent)).resolve()
        if not fcntl or _lock_folder(folder):
            atexit.register(_remove, folder, os.getpid())
            return folder


def _lock_folder(folder: Path) -> bool:
    """Lock a new folder until this process ends; False if another process has just removed it."""
    with suppress(FileNotFoundError):
        lock = os.open(folder, os.O_RDONLY)
        lock_file(lock, exclusive=True)
        if folder.exists():
            return True
        os.close(lock)
    return False


def _remove_unlocked(folder: Path) -> None:
    """Remove a folder unless a process holds its lock."""
    with suppress(OSError):
        lock = os.open(folder, os.O_RDONLY | os.O_DIRECTORY)
        try:
            if lock_file(lock, exclusive=True, wait=False):
                discard(folder)
        finally:
            os.close(lock)


def _remove(folder: Path, process: int) -> None:
    if os.getpid() == process:  # a forked child also runs this
        shutil.rmtree(folder, ignore_errors=True)
