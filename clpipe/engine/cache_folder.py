"""Where compiled programs are kept between processes."""

import atexit
import os
import shutil
import tempfile
from functools import cache
from pathlib import Path

import platformdirs

VARIABLE = "CLPIPE_CACHE_DIR"  # names another folder


@cache
def cache_folder() -> Path:
    """The folder for compiled programs, which is there and can be written to.

    It is the folder that ``CLPIPE_CACHE_DIR`` names, else the user's cache folder for clpipe. Where
    that cannot be written to, it is a temporary folder that is removed when the process ends.
    """
    named = os.environ.get(VARIABLE)
    folder = Path(named) if named else platformdirs.user_cache_path("clpipe")
    # Without a home, the user's cache folder is a relative path that begins with "~".
    if folder.is_absolute() or named:
        try:
            folder.mkdir(parents=True, exist_ok=True)
            with tempfile.TemporaryFile(dir=folder):
                return folder.resolve()
        except OSError:
            pass
    temporary = tempfile.mkdtemp(prefix="clpipe-")
    atexit.register(shutil.rmtree, temporary, ignore_errors=True)
    return Path(temporary)


def keep_pocl_programs() -> None:
    """Have PoCL keep its programs in our folder too, unless the user named another one.

    PoCL reads the variable when the process first asks for its devices. It fails to start at all
    where its own default, the home folder, cannot be written to.
    """
    os.environ.setdefault("POCL_CACHE_DIR", str(cache_folder() / "pocl"))
