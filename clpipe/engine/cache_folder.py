"""Where compiled programs are kept between processes.

What lies there is run, so it is a folder that nobody but this user may write to.
"""

import atexit
import logging
import os
import shutil
import tempfile
from collections.abc import Iterator
from contextlib import suppress
from functools import cache
from pathlib import Path

import platformdirs

from clpipe.base.system import forbids_programs, writable_by_others
from clpipe.engine.pocl_cache import is_sound, list_programs

VARIABLE = "CLPIPE_CACHE_DIR"  # names another folder
OF_POCL = "POCL_CACHE_DIR"  # PoCL's own variable

ROOM = 32 * 2**20  # bytes; with less, PoCL's compiler may end the process
log = logging.getLogger(__name__)


def is_usable(folder: Path | None, runs_code: bool = False) -> bool:
    """Whether compiled programs can be kept in a folder, after it is made if need be.

    ``runs_code`` is whether they are loaded from there, as PoCL does, which needs a file system
    that is not mounted as "noexec".
    """
    if folder is None:
        return False
    try:
        folder.mkdir(mode=0o700, parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=folder):
            has_room = shutil.disk_usage(folder).free >= ROOM
        return has_room and not (runs_code and forbids_programs(folder))
    except OSError:
        return False


def user_folder(name: str | None = None) -> Path | None:
    """The user's cache folder, or that of a program; None for a user without a home."""
    with suppress(RuntimeError):  # newer versions of platformdirs
        folder = platformdirs.user_cache_path(name)
        return None if folder.parts[:1] == ("~",) else folder  # older ones
    return None


@cache  # before prepare_environment() changes the environment
def lasting_folder() -> Path | None:
    """The folder that ``CLPIPE_CACHE_DIR`` names, else the user's cache folder for clpipe."""
    named = os.environ.get(VARIABLE)
    return Path(named) if named else user_folder("clpipe")


@cache
def is_private(folder: Path) -> bool:
    """Whether only this user may write to a folder; if not, that is logged, once."""
    try:
        reason = writable_by_others(folder)
    except OSError:
        return False
    if reason:
        log.warning(
            "%s: %s, and what lies there is run; kernels go to a folder of this process "
            "(chmod 700, or name another with %s)",
            *(folder, reason, VARIABLE),
        )
    return not reason


@cache
def cache_folder(runs_code: bool = False) -> Path | None:
    """The folder for compiled programs; None where there is none. Argument as :func:`is_usable`.

    It is the lasting one, if it is private, else a temporary one.
    """
    folder = lasting_folder()
    if folder and is_usable(folder, runs_code) and is_private(folder):
        return folder.resolve()
    return temporary_folder(runs_code)


@cache
def temporary_folder(runs_code: bool = False) -> Path | None:
    """A folder that is removed when the process ends. Argument as :func:`is_usable`."""
    for place in temporary_places():
        if is_usable(place, runs_code):
            temporary = tempfile.mkdtemp(prefix="clpipe-", dir=place)
            atexit.register(shutil.rmtree, temporary, ignore_errors=True)
            return Path(temporary)
    return None


def temporary_places() -> Iterator[Path]:
    """Folders for temporary files, the usual one first."""
    with suppress(FileNotFoundError):
        yield Path(tempfile.gettempdir())
    yield from (Path("/var/tmp"), Path("/dev/shm"))  # noqa: S108


def later_runs(runs_code: bool) -> str:
    """Where later runs find what is compiled now, in words. Argument as :func:`is_usable`."""
    folder, lasting = cache_folder(runs_code), lasting_folder()
    if folder and lasting and folder == lasting.resolve():
        return f"later runs find them in {folder}"
    return f"later runs do so again, because they cannot be kept in {lasting or 'a home'}"


def prepare_environment() -> None:
    """Have the libraries below keep their caches where they can; before OpenCL is first used.

    PoCL keeps its programs in our folder too, unless the user named another one. Both it and
    pyopencl fail to start where their cache folder cannot be used, so there they get ours.
    """
    named = os.environ.get(OF_POCL)
    if folder := pocl_folder(named):
        os.environ[OF_POCL] = str(folder)
    if not is_usable(user_folder()) and (folder := cache_folder()):
        os.environ["XDG_CACHE_HOME"] = str(folder)


def pocl_folder(named: str | None) -> Path | None:
    """The folder for PoCL's programs, with nothing in it that is damaged; None where there is none.

    ``named`` is what the user named, which comes before ours and a temporary one.
    """
    for place in pocl_places(named):
        with suppress(OSError):
            if is_usable(place, runs_code=True) and is_private(place):
                if is_sound(place.resolve()):
                    return place.resolve()
                log.warning(
                    "%s: damaged, and in use; kernels go to a folder of this process", place
                )
    return None


def list_pocl_programs() -> None:
    """List what PoCL has compiled, so that later processes believe it."""
    if named := os.environ.get(OF_POCL):
        list_programs(Path(named))


def pocl_places(named: str | None) -> Iterator[Path]:
    """Where PoCL may keep its programs, the first choice first; argument as there."""
    if named:
        yield Path(named)
    for folder in (cache_folder, temporary_folder):
        if base := folder(True):
            yield base / "pocl"


def pocl_problem() -> str:
    """Why PoCL has no folder to compile in, or nothing."""
    named = os.environ.get(OF_POCL)
    if named and is_usable(Path(named), runs_code=True):
        return ""
    return (
        "PoCL needs a folder that can be written to and run from (no 'noexec'), with "
        f"{ROOM >> 20} MiB of room; {named or lasting_folder() or 'a home'} and the folders for "
        f"temporary files are none; name one with {VARIABLE}"
    )
