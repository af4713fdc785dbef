"""Intel's OpenCL runtime for CPUs as pip installs it, shown to the loader of OpenCL platforms.

A loader reads the path of each platform's library from an .icd file. The one in Intel's package is
in no folder where loaders look, and names a path that is not there.
"""

import os
import sys
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from importlib.metadata import PackageNotFoundError, files
from pathlib import Path

from clpipe.engine.cache_folder import cache_folder

PACKAGE, LIBRARY = "intel-opencl-rt", "libintelocl.so"
# With any of these a user says where platforms are; the first is what we set.
VARIABLES = ("OCL_ICD_VENDORS", "OCL_ICD_FILENAMES", "OPENCL_VENDOR_PATH")
# Where loaders look by themselves: the system's folder, and conda's.
FOLDERS = (Path("/etc/OpenCL/vendors"), Path(sys.prefix, "etc/OpenCL/vendors"))


def intel_library() -> Path | None:
    """The library of Intel's runtime, if its package is installed."""
    with suppress(PackageNotFoundError):
        for file in files(PACKAGE) or ():
            if file.name == LIBRARY:
                path = Path(str(file.locate())).resolve()
                return path if path.exists() else None
    return None


@contextmanager
def intel_visible() -> Iterator[None]:
    """Within this, a loader that starts finds Intel's runtime beside all others.

    Loaders start when a process first asks for platforms. Nothing changes without Intel's package,
    where the user set one of :data:`VARIABLES`, or where the runtime is found anyhow.
    """
    library, place = intel_library(), cache_folder()
    present = [icd for folder in FOLDERS for icd in sorted(folder.glob("*.icd"))]
    if (
        not library
        or not place
        or any(name in os.environ for name in VARIABLES)
        or any(names_library(icd) for icd in present)
    ):
        yield
        return
    with tempfile.TemporaryDirectory(prefix="vendors-", dir=place) as folder:
        for number, icd in enumerate(present):
            Path(folder, f"{number}.icd").symlink_to(icd)
        Path(folder, "intel.icd").write_text(f"{library}\n", "utf-8")
        os.environ[VARIABLES[0]] = folder
        try:
            yield
        finally:
            del os.environ[VARIABLES[0]]


def names_library(icd: Path) -> bool:
    """Whether an .icd file names a library of Intel's runtime that is there."""
    with suppress(OSError, UnicodeDecodeError):
        path = Path(icd.read_text("utf-8").strip())
        return path.name.startswith(LIBRARY) and path.exists()
    return False
