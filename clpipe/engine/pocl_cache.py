"""PoCL's folder of compiled kernels, looked at before PoCL believes it.

PoCL maps what lies there without a look: a library that was cut ends the process (SIGBUS, SIGABRT),
and a program that was cut compiles to nothing. So an index beside the programs says what was
written, by size, times and digest. Before PoCL is used, whatever is not as it was written, or is
not in the index, is removed, and is compiled again.

Processes that use a folder share a lock. Only who is alone removes; what others have written since
is theirs, and listed when their kernels are compiled.
"""

import json
import os
import shutil
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from types import ModuleType
from typing import Any

import xxhash

from clpipe.base.errors import ImageError
from clpipe.base.files import passing_files, write_whole

fcntl: ModuleType | None
try:
    import fcntl
except ImportError:  # Windows, for which there is no PoCL
    fcntl = None

INDEX, LOCK, INDEX_LOCK = "index.json", "in_use.lock", "index.lock"
TOUCHED = "last_accessed"  # PoCL writes it at each use, and never reads it
_in_use: dict[Path, int] = {}  # descriptors of the locks that this process holds

# Of each file below a program's folder: size, times of change in ns, and digest.
Files = dict[str, list[Any]]


def is_sound(folder: Path) -> bool:
    """See that PoCL may believe what lies in a folder, and hold the folder until the process ends.

    False where something is damaged and other processes use it, so that it cannot be removed.

    Raises:
        OSError: the folder cannot be read, or written to.
    """
    if folder in _in_use:
        return True
    lock = os.open(folder / LOCK, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o600)
    try:
        alone = _try_lock(lock)
        listed, found = _index(folder), dict(_programs(folder))
        for program, files in found.items():
            was = listed.get(program)
            if was is None:
                damaged = alone
            else:
                damaged = not _is_as_it_was(folder / program, was, files, alone)
            if damaged and not alone:
                os.close(lock)
                return False
            if damaged:
                shutil.rmtree(folder / program)
        if alone:
            for left in folder.glob("tempfile*"):
                left.unlink()
        _share(lock)
    except OSError:
        with suppress(OSError):
            os.close(lock)
        raise
    _in_use[folder] = lock
    return True


def list_programs(folder: Path) -> None:
    """List what has been compiled in a folder, so that later processes believe it."""
    if folder not in _in_use:
        return
    with suppress(OSError, ImageError), _locked(folder / INDEX_LOCK):
        listed, found = _index(folder), dict(_programs(folder))
        now: dict[str, Files] = {}
        for program, files in found.items():
            was = listed.get(program, {})
            now[program] = {
                # What is listed stays as it is, so that what changes later is still noticed.
                name: was[name] if name in was else [*stamp, _digest(folder / program / name)]
                for name, stamp in files.items()
            }
        if now != listed:
            with passing_files():
                write_whole(folder / INDEX, json.dumps(now).encode())


def _is_as_it_was(program: Path, was: Files, files: Files, alone: bool) -> bool:
    """Whether a program's files are those of the index; a time that differs has them read."""
    if not was.keys() <= files.keys() or (alone and was.keys() != files.keys()):
        return False
    return all(
        was[name][:3] == files[name]
        or (was[name][0] == files[name][0] and was[name][3] == _digest(program / name))
        for name in was
    )


def _programs(folder: Path) -> Iterator[tuple[str, Files]]:
    """The programs in PoCL's folder, by their place in it, with size and times of their files."""
    for group in _folders(folder):
        for program in _folders(group):
            files = {}
            for place, _, names in os.walk(program):
                for name in names:
                    if name != TOUCHED:
                        path = os.path.join(place, name)
                        status = os.lstat(path)
                        stamp = [status.st_size, status.st_mtime_ns, status.st_ctime_ns]
                        files[os.path.relpath(path, program)] = stamp
            yield f"{group.name}/{program.name}", files


def _folders(folder: Path) -> list[Path]:
    with os.scandir(folder) as entries:
        return [Path(entry.path) for entry in entries if entry.is_dir(follow_symlinks=False)]


def _index(folder: Path) -> dict[str, Files]:
    """What the index lists; nothing where it is damaged."""
    try:
        listed = json.loads((folder / INDEX).read_bytes())
        for files in listed.values():
            for size, modified, changed, digest in files.values():
                if [*map(type, (size, modified, changed, digest))] != [int, int, int, str]:
                    return {}
    except (OSError, ValueError, AttributeError, TypeError):
        return {}
    return listed


def _digest(path: Path) -> str:
    return xxhash.xxh3_128_hexdigest(path.read_bytes())


def _try_lock(lock: int) -> bool:
    """Lock a file for this process alone, if no other one uses it; else wait to share it."""
    if fcntl is None:
        return True
    try:
        fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError:
        _share(lock)
        return False
    return True


def _share(lock: int) -> None:
    """Share a lock; a file system without locks has none."""
    if fcntl is not None:
        with suppress(OSError):
            fcntl.flock(lock, fcntl.LOCK_SH)


@contextmanager
def _locked(path: Path) -> Iterator[None]:
    """Hold a lock that others wait for."""
    lock = os.open(path, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o600)
    try:
        if fcntl is not None:
            with suppress(OSError):
                fcntl.flock(lock, fcntl.LOCK_EX)
        yield
    finally:
        os.close(lock)
