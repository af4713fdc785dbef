"""Makes Intel's OpenCL runtime for CPUs, as installed by pip, visible to the OpenCL loader.

A loader reads the path of each platform's library from an .icd file. The .icd file of Intel's
package is in a folder that loaders do not search, and names a missing path.
"""

import os
import subprocess
import sys
import tempfile
from collections.abc import Collection, Iterator
from contextlib import contextmanager, suppress
from importlib.metadata import PackageNotFoundError, files
from pathlib import Path
from typing import Any

from clpipe.base.errors import DeviceError
from clpipe.base.extras import install_command
from clpipe.base.process_folder import process_folder
from clpipe.engine.cache_folder import prepare_environment

LIMIT = 60  # seconds to load a driver's library
PACKAGE, LIBRARY = "intel-opencl-rt", "libintelocl.so"
# Each of these variables names the folders or files of platforms. clpipe sets the first one.
VARIABLES = ("OCL_ICD_VENDORS", "OCL_ICD_FILENAMES", "OPENCL_VENDOR_PATH")
# The runtime in pyopencl's wheel, which its loader finds through this variable.
BUNDLED, HOME = "PoCL of pip", "PYOPENCL_HOME"
# The folders that loaders search by default: the system's, and conda's.
FOLDERS = (Path("/etc/OpenCL/vendors"), Path(sys.prefix, "etc/OpenCL/vendors"))


def intel_library() -> Path | None:
    """Return the library of Intel's runtime; None if its package is not installed."""
    with suppress(PackageNotFoundError):
        for file in files(PACKAGE) or ():
            if file.name == LIBRARY:
                path = Path(str(file.locate())).resolve()
                return path if path.exists() else None
    return None


def icd_files() -> list[tuple[Path, str]]:
    """Return the installed .icd files and their contents; "" if a file cannot be read."""
    found = []
    for path in (icd for folder in FOLDERS for icd in sorted(folder.glob("*.icd"))):
        try:
            found.append((path, path.read_text("utf-8")))
        except (OSError, UnicodeDecodeError):
            found.append((path, ""))
    return found


def unloadable_drivers() -> dict[str, str]:
    """Return the .icd files whose library cannot be loaded, with the reason.

    Loaders skip such files without a message. A child process loads each library, because a broken
    one may crash it.
    """
    found = {}
    for path, text in icd_files():
        if not text.strip():
            found[str(path)] = "it is empty or cannot be read"
            continue
        command = [sys.executable, "-c", "import ctypes, sys; ctypes.CDLL(sys.argv[1])"]
        with suppress(OSError, subprocess.TimeoutExpired):
            done = subprocess.run(  # noqa: S603 - the file that the loader itself loads
                [*command, text.strip()], capture_output=True, timeout=LIMIT, check=False
            )
            if done.returncode:
                lines = done.stderr.decode("utf-8", "replace").strip().splitlines()
                reason = lines[-1].removeprefix("OSError: ") if lines else "it crashes the process"
                found[str(path)] = f"its library cannot be loaded: {reason}"
    return found


def load_pyopencl() -> Any:
    """Return pyopencl, after preparing the environment. Every use of OpenCL starts here.

    Raises:
        DeviceError: pyopencl cannot be loaded.
    """
    prepare_environment()
    try:
        import pyopencl as cl
    except (ImportError, OSError) as error:
        way = f"Use --device numpy, or run: {install_command('--force-reinstall', 'pyopencl')}"
        raise DeviceError(f"pyopencl cannot be loaded: {error}. {way}") from None
    return cl


def installed_drivers() -> list[str]:
    """Return the runtimes that can be hidden from the loader: .icd files, and :data:`BUNDLED`.

    If the user has set one of :data:`VARIABLES`, the .icd files cannot be hidden.
    """
    bundled = [BUNDLED] if any(Path(load_pyopencl().__file__).parent.glob(".libs/*.icd")) else []
    named = any(name in os.environ for name in VARIABLES)
    return bundled if named else [*bundled, *(str(path) for path, _ in icd_files())]


def platforms(hidden: Collection[str] = ()) -> list[Any]:
    """Return the OpenCL platforms of this machine, as ``pyopencl.Platform``.

    Later calls in a process return the same platforms, whatever is hidden.

    Args:
        hidden: the :func:`installed_drivers` that must not be loaded.

    Raises:
        DeviceError: pyopencl cannot be loaded, or the platforms cannot be listed.
    """
    cl = load_pyopencl()
    try:
        with drivers_visible(hidden):
            return list(cl.get_platforms())
    except cl.Error as error:
        if "PLATFORM_NOT_FOUND" in str(error):
            return []
        raise DeviceError(
            f"the OpenCL platforms cannot be listed: {error}. Reinstall the driver of your GPU, or "
            "use --device numpy."
        ) from None


@contextmanager
def drivers_visible(hidden: Collection[str] = ()) -> Iterator[None]:
    """Make a loader that starts in the ``with`` block find Intel's runtime, and hide others.

    Loaders start when a process first asks for platforms. This changes nothing if the user has set
    one of :data:`VARIABLES`. It also changes nothing if no driver is hidden, and Intel's runtime is
    either not installed or already visible.
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
    """Return whether the contents of an .icd file name an existing library of Intel's runtime."""
    path = Path(text.strip())
    return path.name.startswith(LIBRARY) and path.exists()
