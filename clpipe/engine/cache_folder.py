"""The folders in which clpipe, PoCL and pyopencl cache compiled programs.

clpipe uses the folder that ``CLPIPE_CACHE_DIR`` names, or else the user's cache folder. It runs the
programs in this folder, so it uses the folder only if no other user may write to it.

:func:`prepare_environment` sets two variables. ``POCL_CACHE_DIR`` always names a folder that only
this process uses. ``XDG_CACHE_HOME``, for pyopencl, changes only if the user's folder is unusable.
"""

import logging
import os
import tempfile
from contextlib import suppress
from functools import cache
from pathlib import Path

import platformdirs

from clpipe.base.process_folder import MIN_FREE_SPACE, process_folder
from clpipe.base.system import writable_by_others

VARIABLE = "CLPIPE_CACHE_DIR"  # names another folder
POCL_SWITCH = "POCL_KERNEL_CACHE"  # PoCL caches nothing if this is set, unless it begins with "1"
log = logging.getLogger(__name__)


def is_usable(folder: Path | None) -> bool:
    """Return whether files can be written to a folder. A missing folder is created."""
    if folder is None:
        return False
    try:
        folder.mkdir(mode=0o700, parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=folder):
            return True
    except OSError:
        return False


def user_folder(name: str | None = None) -> Path | None:
    """Return the user's cache folder, or a program's folder in it; None if there is no home."""
    with suppress(RuntimeError):  # newer versions of platformdirs
        folder = platformdirs.user_cache_path(name)
        return None if folder.parts[:1] == ("~",) else folder  # older ones
    return None


# Read when this module is loaded, because prepare_environment changes XDG_CACHE_HOME later.
DEFAULT_FOLDER = user_folder("clpipe")


def configured_folder() -> Path | None:
    """Return the folder that ``CLPIPE_CACHE_DIR`` names, or the user's cache folder for clpipe."""
    named = os.environ.get(VARIABLE)
    return Path(named) if named else DEFAULT_FOLDER


@cache
def cache_folder() -> Path | None:
    """Return the folder for kernels. It may be read-only.

    Returns:
        None if the folder is missing and cannot be created, or if others may write to it.
    """
    folder = configured_folder()
    if folder and (is_usable(folder) or folder.is_dir()) and is_private(folder):
        return folder.resolve()
    return None


def is_private(folder: Path) -> bool:
    """Return whether only this user may write to a folder. If not, log a warning."""
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


def pocl_caches_nothing() -> bool:
    """Return whether the user has switched PoCL's cache off."""
    return not os.environ.get(POCL_SWITCH, "1").startswith("1")


def cache_problem() -> str:
    """Return why kernels that are compiled now cannot be cached; "" if they can."""
    if is_usable(cache_folder()):
        return ""
    return f"they cannot be cached in {configured_folder() or 'the home directory'}"


def pocl_folder() -> Path | None:
    """Return the folder that PoCL compiles in, or None if there is none."""
    folder = process_folder()
    return folder / "pocl" if folder else None


def prepare_environment() -> None:
    """Set the cache folders of PoCL and pyopencl. Call this before pyopencl is loaded.

    PoCL trusts every file in its folder. Therefore it gets a folder that only this process uses,
    even if the variable is set. pyopencl fails to start if its cache folder is unusable.
    """
    if folder := pocl_folder():
        os.environ["POCL_CACHE_DIR"] = str(folder)
    if not is_usable(user_folder()) and (folder := process_folder()):
        os.environ["XDG_CACHE_HOME"] = str(folder)


def pocl_problem() -> str:
    """Return why PoCL has no folder to compile in; "" if it has one."""
    if process_folder():
        return ""
    return (
        f"PoCL needs a writable folder for temporary files with {MIN_FREE_SPACE >> 20} MiB of free "
        "space, mounted without 'noexec'. Set TMPDIR to such a folder"
    )
