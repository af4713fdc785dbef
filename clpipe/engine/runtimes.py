"""The types of OpenCL devices, and how kernels are compiled for them."""

import ctypes
import os
import shutil
import sys
from pathlib import Path
from typing import Any

from clpipe.engine.cache_folder import pocl_problem
from clpipe.engine.cpu_target import Target

# Compilers read environment variables with these prefixes. The named ones do not affect the code.
PREFIXES = ("POCL_", "CL_CONFIG_")
RUN_TIME_VARIABLES = (
    *("POCL_CACHE_DIR", "POCL_KERNEL_CACHE", "POCL_DEVICES", "POCL_MEMORY_LIMIT"),
    *("POCL_MAX_PTHREAD_COUNT", "POCL_CPU_MAX_CU_COUNT", "POCL_PTHREAD_MIN_THREADS"),
    *("POCL_AFFINITY", "POCL_STARTUP_DELAY", "POCL_SIGFPE_HANDLER", "POCL_SIGUSR2_HANDLER"),
    *("POCL_DEBUG", "POCL_TRACING", "POCL_TRACING_OPT", "POCL_TRACING_FILTER"),
)


def is_pocl(platform: str) -> bool:
    """Return whether a platform is PoCL, by its name."""
    return "Portable Computing" in platform


def type_of(platform: Any, device: Any) -> str:
    """Return the type of a ``pyopencl.Device``: "GPU", "CPU", "emulator" or "accelerator"."""
    import pyopencl as cl

    if "oclgrind" in platform.name.lower():
        return "emulator"  # Oclgrind finds errors in kernels, is slow, and reports all types
    if not device.type & (cl.device_type.GPU | cl.device_type.CPU):
        return "accelerator"
    return "GPU" if device.type & cl.device_type.GPU else "CPU"


def lanes_for(type_: str, platform: Any, device: Any, target: Target) -> int:
    """Return the lanes for which kernels are compiled: one vector register on a CPU, 1 on a GPU.

    A CPU that reports a native vector width of 1 has a compiler like a GPU's. This is Mesa's
    rusticl, which computes wrong images with more lanes.
    """
    if type_ != "CPU":
        return 1
    if is_pocl(platform.name):
        return 16 if target.is_wide else 8
    width = device.native_vector_width_float
    return 1 if width == 1 else 8 if width < 16 else 16


def device_problem(type_: str, platform: Any, device: Any) -> str:
    """Return why a device is unusable, as far as this is known without a test; else ""."""
    if type_ == "accelerator":
        return "it is neither a GPU nor a CPU, but an emulator or an FPGA"
    if not device.available or not device.compiler_available:
        return "it is not available or has no compiler"
    if is_pocl(platform.name) and not shutil.which("ld"):
        return (
            "PoCL needs a linker, but there is no 'ld' on the PATH. "
            "Install binutils (Debian, Ubuntu: apt-get install binutils)"
        )
    return pocl_problem() if is_pocl(platform.name) else ""


def needs_test(type_: str, platform: Any, device: Any) -> bool:
    """Return whether a device is tested before it is used. Emulators would take too long."""
    return type_ in ("GPU", "CPU") and not device_problem(type_, platform, device)


def platform_id(platform: Any) -> str:
    """Return a text that identifies a platform and its version."""
    return f"{platform.name.strip()}, {platform.version.strip()}"


def compiler_key(platform: Any, device: Any, target: Target) -> tuple[str, ...]:
    """Return texts that identify everything that determines compiled kernels, except the source.

    PoCL's own cache depends on the path of its headers and on variables. It compiles again if they
    differ, for example in a copy of an environment.
    """
    library = library_of(platform.int_ptr)
    variables = {
        name: value
        for name, value in sorted(os.environ.items())
        if name.startswith(PREFIXES) and name not in RUN_TIME_VARIABLES
    }
    return (
        attempt(platform, device, target),
        f"{library}, {library.stat().st_size} bytes" if library else "",
        repr(variables),
    )


def library_of(platform: int) -> Path | None:
    """Return the file of a platform's library; None if it cannot be found.

    Args:
        platform: the platform's handle. By the ICD extension (Khronos, cl_khr_icd), it points to a
            pointer to the table of the library's functions.
    """
    if sys.platform != "linux":
        return None
    functions = ctypes.cast(platform, ctypes.POINTER(ctypes.POINTER(ctypes.c_void_p)))[0]
    symbol = (ctypes.c_char_p * 4)()  # dladdr's Dl_info, which begins with the library's path
    if not ctypes.CDLL(None).dladdr(ctypes.c_void_p(functions[1]), symbol):
        return None
    file = Path(os.fsdecode(symbol[0] or b"")).resolve()
    return file if file.is_file() else None


def attempt(platform: Any, device: Any, target: Target) -> str:
    """Return a text that identifies all conditions on which the result of a test depends."""
    parts = (platform_id(platform), device.name, device.version, device.driver_version, target.name)
    return " | ".join(part.strip() for part in parts)
