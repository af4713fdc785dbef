"""Where compiled programs are kept between processes."""

import atexit
import os
import shutil
import tempfile
from functools import cache
from pathlib import Path

import platformdirs

VARIABLE = "CLPIPE_CACHE_DIR"  # names another folder


def is_writable(folder: Path) -> bool:
    """Whether a folder can be written to, after it is made if need be."""
    if folder.parts[:1] == ("~",):  # the user has no home
        return False
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=folder):
            return True
    except OSError:
        return False


@cache
def cache_folder() -> Path:
    """The folder for compiled programs, which is there and can be written to.

    It is the folder that ``CLPIPE_CACHE_DIR`` names, else the user's cache folder for clpipe. Where
    that cannot be written to, it is a temporary folder that is removed when the process ends.
    """
    named = os.environ.get(VARIABLE)
    folder = Path(named) if named else platformdirs.user_cache_path("clpipe")
    if is_writable(folder):
        return folder.resolve()
    temporary = tempfile.mkdtemp(prefix="clpipe-")
    atexit.register(shutil.rmtree, temporary, ignore_errors=True)
    return Path(temporary)


def prepare_environment() -> None:
    """Have the libraries below keep their caches where they can; before OpenCL is first used.

    PoCL keeps its programs in our folder too, unless the user named another one. Both it and
    pyopencl fail to start where the user's cache folder cannot be written to, so there pyopencl
    gets ours as well.
    """
    folder = cache_folder()
    os.environ.setdefault("POCL_CACHE_DIR", str(folder / "pocl"))
    if not is_writable(platformdirs.user_cache_path()):
        os.environ["XDG_CACHE_HOME"] = str(folder)
