"""The types of OpenCL devices, and how kernels are compiled for them."""

import shutil
from typing import Any

from clpipe.engine.cache_folder import pocl_problem
from clpipe.engine.cpu_target import Target


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


def attempt(platform: Any, device: Any, target: Target) -> str:
    """Return a text that identifies all conditions on which the result of a test depends."""
    parts = (platform_id(platform), device.name, device.version, device.driver_version, target.name)
    return " | ".join(part.strip() for part in parts)
