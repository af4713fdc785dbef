"""Where compiled programs are kept: by clpipe, by PoCL and by pyopencl.

=========  =====================  ==================================================
who        variable               folder
=========  =====================  ==================================================
clpipe     ``CLPIPE_CACHE_DIR``   the user's cache folder for clpipe, if not set
PoCL       ``POCL_CACHE_DIR``     in the folder of this process, always
pyopencl   ``XDG_CACHE_HOME``     the user's; that of this process if it is unusable
=========  =====================  ==================================================

:func:`prepare_environment` sets the last two variables. clpipe runs the programs that it keeps, so
it uses its folder only if nobody but this user may write to it.
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


# Read when this module is loaded, because prepare_environment changes XDG_CACHE_HOME later.
OWN_FOLDER = user_folder("clpipe")


def wanted_folder() -> Path | None:
    """Return the folder that ``CLPIPE_CACHE_DIR`` names, or the user's cache folder for clpipe."""
    named = os.environ.get(VARIABLE)
    return Path(named) if named else OWN_FOLDER


@cache
def cache_folder() -> Path | None:
    """Return the folder for kernels, or None if it is unusable or others may write to it."""
    folder = wanted_folder()
    return folder.resolve() if folder and is_usable(folder) and is_private(folder) else None


def is_private(folder: Path) -> bool:
    """Whether only this user may write to a folder; if not, that is logged."""
    try:
        reason = writable_by_others(folder)
    except OSError:
        return False
    if reason:
        log.warning(
            "%s: %s, and clpipe runs the programs in it. Kernels are therefore not cached. "
            "Use chmod 700, or name another folder with %s.",
            *(folder, reason, VARIABLE),
        )
    return not reason


def later_runs() -> str:
    """Return in words where later runs find what is compiled now."""
    if folder := cache_folder():
        return f"later runs find them in {folder}"
    place = wanted_folder() or "the home directory"
    return f"later runs compile them again, because they cannot be cached in {place}"


def pocl_folder() -> Path | None:
    """Return the folder that PoCL compiles in, or None if there is none."""
    folder = process_folder()
    return folder / "pocl" if folder else None


def prepare_environment() -> None:
    """Tell PoCL and pyopencl where to keep their caches. Call this before pyopencl is loaded.

    PoCL trusts every file that it finds, so it gets a folder that only this process uses, whatever
    the variable says. pyopencl fails to start if its cache folder is unusable.
    """
    if folder := pocl_folder():
        os.environ["POCL_CACHE_DIR"] = str(folder)
    if not is_usable(user_folder()) and (folder := process_folder()):
        os.environ["XDG_CACHE_HOME"] = str(folder)


def pocl_problem() -> str:
    """Why PoCL has no folder to compile in, or nothing."""
    if process_folder():
        return ""
    return (
        f"PoCL needs a writable folder for temporary files with {ROOM >> 20} MiB of free space, "
        "mounted without 'noexec'. Set TMPDIR to such a folder"
    )
