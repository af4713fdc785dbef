"""Intel's OpenCL runtime for CPUs as pip installs it, shown to the loader of OpenCL platforms.

A loader reads the path of each platform's library from an .icd file. The one in Intel's package is
in no folder where loaders look, and names a path that is not there.
"""

import os
import sys
import tempfile
from collections.abc import Collection, Iterator
from contextlib import contextmanager, suppress
from importlib.metadata import PackageNotFoundError, files
from pathlib import Path
from typing import Any

from clpipe.base.errors import DeviceError
from clpipe.base.process_folder import process_folder
from clpipe.engine.cache_folder import prepare_environment

PACKAGE, LIBRARY = "intel-opencl-rt", "libintelocl.so"
# With any of these a user says where platforms are; the first is what we set.
VARIABLES = ("OCL_ICD_VENDORS", "OCL_ICD_FILENAMES", "OPENCL_VENDOR_PATH")
# The runtime that comes with pyopencl's wheel, which its loader finds through this variable.
BUNDLED, HOME = "PoCL of pip", "PYOPENCL_HOME"
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


def icd_files() -> list[tuple[Path, str]]:
    """The files that tell loaders of runtimes, and what each says; "" where it cannot be read."""
    found = []
    for path in (icd for folder in FOLDERS for icd in sorted(folder.glob("*.icd"))):
        try:
            found.append((path, path.read_text("utf-8")))
        except (OSError, UnicodeDecodeError):
            found.append((path, ""))
    return found


def loaded() -> Any:
    """Return pyopencl. Every use of OpenCL starts here, in an environment that suits it.

    Raises:
        DeviceError: it cannot be loaded.
    """
    prepare_environment()
    try:
        import pyopencl as cl
    except (ImportError, OSError) as error:
        raise DeviceError(f"pyopencl cannot be loaded: {error}") from None
    return cl


def installed_drivers() -> list[str]:
    """The runtimes that can be hidden from the loader: paths of .icd files, and :data:`BUNDLED`.

    Where the user said where platforms are, by one of :data:`VARIABLES`, the .icd files stay.
    """
    bundled = [BUNDLED] if any(Path(loaded().__file__).parent.glob(".libs/*.icd")) else []
    named = any(name in os.environ for name in VARIABLES)
    return bundled if named else [*bundled, *(str(path) for path, _ in icd_files())]


def platforms(hidden: Collection[str] = ()) -> list[Any]:
    """The OpenCL platforms of this machine, as ``pyopencl.Platform``.

    A process that has listed them gets the same ones again.

    Args:
        hidden: some of :func:`installed_drivers`, which are not loaded.

    Raises:
        DeviceError: pyopencl cannot be loaded, or the platforms cannot be listed.
    """
    cl = loaded()
    try:
        with drivers_visible(hidden):
            return list(cl.get_platforms())
    except cl.Error as error:
        if "PLATFORM_NOT_FOUND" in str(error):
            return []
        raise DeviceError(f"OpenCL cannot be used: {error}") from None


@contextmanager
def drivers_visible(hidden: Collection[str] = ()) -> Iterator[None]:
    """Within this, a loader that starts finds Intel's runtime beside all others but hidden ones.

    Loaders start when a process first asks for platforms. Nothing changes where the user set one of
    :data:`VARIABLES`, or where nothing is hidden and Intel's runtime is found anyhow, or not
    installed.
    """
    home = os.environ.get(HOME)
    if BUNDLED in hidden:
        os.environ[HOME] = os.devnull
    library, place, present = intel_library(), process_folder(), icd_files()
    if any(names_library(text) for _, text in present):
        library = None
    kept = [path for path, _ in present if str(path) not in hidden]
    try:
        if (
            not place
            or any(name in os.environ for name in VARIABLES)
            or (not library and len(kept) == len(present))
        ):
            yield
            return
        with tempfile.TemporaryDirectory(prefix="vendors-", dir=place) as folder:
            for number, icd in enumerate(kept):
                Path(folder, f"{number}.icd").symlink_to(icd)
            if library:
                Path(folder, "intel.icd").write_text(f"{library}\n", "utf-8")
            os.environ[VARIABLES[0]] = folder
            try:
                yield
            finally:
                del os.environ[VARIABLES[0]]
    finally:
        if home is not None:
            os.environ[HOME] = home


def names_library(text: str) -> bool:
    """Whether what an .icd file says is a library of Intel's runtime that is there."""
    path = Path(text.strip())
    return path.name.startswith(LIBRARY) and path.exists()
