"""Folders in which compiled programs are kept between processes, by us and the libraries below.

What is kept is run, so it is a folder that nobody but this user may write to.
"""

import logging
import os
import tempfile
from contextlib import suppress
from functools import cache
from pathlib import Path

import platformdirs

from clpipe.base.process_folder import ROOM, process_folder
from clpipe.base.system import writable_by_others

VARIABLE = "CLPIPE_CACHE_DIR"  # names another folder
log = logging.getLogger(__name__)


def is_usable(folder: Path | None) -> bool:
    """Whether files can be written to a folder, after it is made if need be."""
    if folder is None:
        return False
    try:
        folder.mkdir(mode=0o700, parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=folder):
            return True
    except OSError:
        return False


def user_folder(name: str | None = None) -> Path | None:
    """The user's cache folder, or that of a program; None for a user without a home."""
    with suppress(RuntimeError):  # newer versions of platformdirs
        folder = platformdirs.user_cache_path(name)
        return None if folder.parts[:1] == ("~",) else folder  # older ones
    return None


@cache
def lasting_folder() -> Path | None:
    """The folder that ``CLPIPE_CACHE_DIR`` names, else the user's cache folder for clpipe."""
    named = os.environ.get(VARIABLE)
    return Path(named) if named else user_folder("clpipe")


@cache
def cache_folder() -> Path | None:
    """The lasting folder, where it can be used and is the user's alone; None where not."""
    folder = lasting_folder()
    return folder.resolve() if folder and is_usable(folder) and is_private(folder) else None


def is_private(folder: Path) -> bool:
    """Whether only this user may write to a folder; if not, that is logged."""
    try:
        reason = writable_by_others(folder)
    except OSError:
        return False
    if reason:
        log.warning(
            "%s: %s, and what lies there is run; kernels are not kept "
            "(chmod 700, or name another folder with %s)",
            *(folder, reason, VARIABLE),
        )
    return not reason


def later_runs() -> str:
    """Where later runs find what is compiled now, in words."""
    if folder := cache_folder():
        return f"later runs find them in {folder}"
    return f"later runs do so again, because they cannot be kept in {lasting_folder() or 'a home'}"


def pocl_folder() -> Path | None:
    """The folder that PoCL compiles in; None where there is none."""
    folder = process_folder()
    return folder / "pocl" if folder else None


def prepare_environment() -> None:
    """Have the libraries below keep their caches where they can; before OpenCL is first used.

    PoCL believes all that it finds, so it gets a folder of this process alone, whatever the
    variable says. pyopencl fails to start where its cache folder cannot be used.
    """
    lasting_folder()  # remembers the user's folder, before XDG_CACHE_HOME changes below
    if folder := pocl_folder():
        os.environ["POCL_CACHE_DIR"] = str(folder)
    if not is_usable(user_folder()) and (folder := process_folder()):
        os.environ["XDG_CACHE_HOME"] = str(folder)


def pocl_problem() -> str:
    """Why PoCL has no folder to compile in, or nothing."""
    if process_folder():
        return ""
    return (
        "PoCL needs a folder for temporary files that can be written to and run from (no "
        f"'noexec'), with {ROOM >> 20} MiB of room; name one with TMPDIR"
    )
