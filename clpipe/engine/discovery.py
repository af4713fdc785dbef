"""The OpenCL devices of this machine, and which of them to use."""

import os
import shutil
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from clpipe.base.errors import DeviceError
from clpipe.base.memory import available_memory
from clpipe.base.text import one_of
from clpipe.engine.cache_folder import pocl_problem, prepare_environment
from clpipe.engine.hardware import Hardware, hardware_of
from clpipe.engine.vendors import intel_visible

_process: int | None = None  # the process id that first used OpenCL, here or before a fork


@dataclass(frozen=True)
class DeviceInfo:
    """A device that an OpenCL platform offers.

    ``problem`` says why it cannot be used; it is empty where it can.
    """

    index: int
    platform: str
    name: str
    type: str  # "GPU", "CPU", "emulator" or "accelerator"
    version: str  # of OpenCL, as the device tells it
    driver: str
    compute_units: int
    memory: int  # bytes
    max_buffer: int  # bytes
    lanes: int
    problem: str
    handle: Any
    hardware: Hardware

    @property
    def label(self) -> str:
        """Name and platform, as people tell devices apart."""
        return f"{self.name.strip()} ({self.platform})"

    @property
    def in_place(self) -> bool:
        """Whether kernels can use the host's memory where it is, at the speed of their own."""
        return self.type == "CPU" and bool(self.handle.host_unified_memory)

    @property
    def alignment(self) -> int:
        """What the address of such memory must be a multiple of, in bytes.

        Intel's runtime copies all that is not, which takes five times as long as a copy of ours;
        PoCL takes any.
        """
        return 1 if is_pocl(self.platform) else self.handle.mem_base_addr_align // 8


def find_devices() -> list[DeviceInfo]:
    """Every device of every OpenCL platform, in the platforms' order.

    Raises:
        DeviceError: pyopencl cannot be loaded, or this process cannot use it.
    """
    global _process
    if _process not in (None, os.getpid()):
        raise DeviceError(
            "this process was forked from one that had used OpenCL, which would hang here; let it "
            'be spawned (multiprocessing\'s "spawn" or "forkserver"), or fork before'
        )
    _process = os.getpid()
    prepare_environment()
    try:
        import pyopencl as cl
    except (ImportError, OSError) as error:
        raise DeviceError(f"pyopencl cannot be loaded: {error}") from None
    try:
        with intel_visible():
            platforms = cl.get_platforms()
    except cl.Error as error:
        if "PLATFORM_NOT_FOUND" in str(error):
            return []
        raise DeviceError(f"OpenCL cannot be used: {error}") from None
    found: list[DeviceInfo] = []
    for platform in platforms:
        try:
            devices, reason = platform.get_devices(), "it offers no device"
        except cl.Error as error:
            devices, reason = [], f"it offers no device: {error}"
        found += [describe(len(found) + i, platform, d) for i, d in enumerate(devices)]
        if not devices:
            problem = pocl_problem() if is_pocl(platform.name) else ""
            found.append(without_device(len(found), platform, problem or reason))
    return found


def describe(index: int, platform: Any, device: Any) -> DeviceInfo:
    """What is to be known of a ``pyopencl.Device``."""
    import pyopencl as cl

    kind = device.type
    type_ = "GPU" if kind & cl.device_type.GPU else "CPU"
    if not kind & (cl.device_type.GPU | cl.device_type.CPU):
        type_ = "accelerator"
    if "oclgrind" in platform.name.lower():
        type_ = "emulator"  # it finds errors in kernels, slowly, and says it is all types
    return DeviceInfo(
        index=index,
        platform=platform.name.strip(),
        name=device.name.strip(),
        type=type_,
        version=device.version.strip(),
        driver=device.driver_version.strip(),
        compute_units=device.max_compute_units,
        memory=device.global_mem_size,
        max_buffer=device.max_mem_alloc_size,
        lanes=lanes_for(type_, platform.name, device),
        problem=problem_with(type_, platform.name, device),
        handle=device,
        hardware=hardware_of(device),
    )


def without_device(index: int, platform: Any, reason: str) -> DeviceInfo:
    """A platform that is installed and has nothing to offer; its user wants to know why."""
    return DeviceInfo(
        index=index,
        platform=platform.name.strip(),
        name="no device",
        type="none",
        version=platform.version.strip(),
        driver="",
        compute_units=0,
        memory=0,
        max_buffer=0,
        lanes=0,
        problem=reason,
        handle=None,
        hardware=Hardware(platform.int_ptr),
    )


def is_pocl(platform: str) -> bool:
    """Whether a platform is PoCL, by its name."""
    return "Portable Computing" in platform


# CPUs with AVX-512, as LLVM names them, whose code from PoCL 3.0 (LLVM 14) is right and twice as
# wide. On later ones that it takes for others (AMD Zen 4) it crashes on 16 lanes.
WIDE_IN_POCL = (
    "skylake-avx512",
    "cascadelake",
    "cooperlake",
    "cannonlake",
    "icelake-client",
    "icelake-server",
    "tigerlake",
    "rocketlake",
    "sapphirerapids",
)


def lanes_for(type_: str, platform: str, device: Any) -> int:
    """How many lanes the kernels are compiled for: one vector register on a CPU, 1 on a GPU.

    A CPU whose natural vectors are one wide has a compiler like a GPU's: Mesa's rusticl, which gets
    the pictures of wider ones wrong.
    """
    if type_ != "CPU":
        return 1
    if is_pocl(platform):
        # The version ends with the name of the CPU that PoCL compiles for.
        return 16 if device.version.strip().endswith(WIDE_IN_POCL) else 8
    width = device.native_vector_width_float
    return 1 if width == 1 else 8 if width < 16 else 16


def problem_with(type_: str, platform: str, device: Any) -> str:
    """Why a device cannot be used, or nothing."""
    if type_ == "accelerator":
        return "neither a GPU nor a CPU (an emulator or an FPGA)"
    if not device.available or not device.compiler_available:
        return "it is not available or has no compiler"
    if is_pocl(platform) and not shutil.which("ld"):
        return (
            "PoCL needs a linker and there is no 'ld' on the PATH "
            "(Debian, Ubuntu: apt-get install binutils; conda: binutils)"
        )
    return pocl_problem() if is_pocl(platform) else ""


def choose(selector: str | None, devices: list[DeviceInfo]) -> DeviceInfo:
    """The device to use: the one that a selector names, else the first usable one by :func:`rank`.

    Args:
        selector: an index from ``clpipe devices``, or a part of a device's or platform's name.

    Raises:
        DeviceError: there is no device, none matches, or the one that matches cannot be used.
    """
    if not devices:
        places = ("OCL_ICD_VENDORS", "OCL_ICD_FILENAMES")  # where the loader looks for platforms
        limits = "".join(f" ({n} is {os.environ[n]!r})" for n in places if n in os.environ)
        raise DeviceError(
            f"no OpenCL platform was found{limits}; install one (your GPU's driver, or for CPUs "
            "Debian's and Ubuntu's pocl-opencl-icd; docs/install.md has other systems), or use "
            "--device numpy, which is slow but needs none"
        )
    if selector is not None:
        matching = [
            d
            for d in devices
            if (selector == str(d.index) if selector.isdecimal() else matches(selector, d))
        ]
        if not matching:
            names = [f"{d.index}: {d.label}" for d in devices]
            raise DeviceError(one_of("device", selector, [*names, "numpy"]))
        usable = [d for d in matching if not d.problem]
        if not usable:
            raise DeviceError(f"device {matching[0].label}: {matching[0].problem}")
        return min(usable, key=rank)
    usable = [d for d in devices if d.type in ("GPU", "CPU") and not d.problem]
    if not usable:
        reasons = "; ".join(f"{d.label}: {d.problem or 'an emulator'}" for d in devices)
        raise DeviceError(f"no usable OpenCL device ({reasons}); or use --device numpy")
    return min(usable, key=rank)


def rank(device: DeviceInfo) -> int:
    """A device's place among those to use by default: GPUs, CPUs by how fast their platform is."""
    if device.type == "GPU":
        return 0
    if "Intel" in device.platform:
        return 1
    return 2 if is_pocl(device.platform) else 3


def choose_all(selectors: Sequence[str], devices: list[DeviceInfo]) -> list[DeviceInfo]:
    """The devices that selectors name; each selector as in :func:`choose`.

    Without selectors: the default device and, if it is a GPU, all other GPUs of the same name,
    because these give the same bits. Each device is there once, also where two drivers offer it.

    Raises:
        DeviceError: as :func:`choose`.
    """
    if not selectors:
        first = choose(None, devices)
        chosen = [first] + [
            d
            for d in devices
            if d.type == first.type == "GPU" and d.name == first.name and not d.problem
        ]
    else:
        chosen = [choose(selector, devices) for selector in selectors]
    distinct: list[DeviceInfo] = []
    for device in chosen:
        if not any(
            device.index == d.index or device.hardware.is_same(d.hardware) for d in distinct
        ):
            distinct.append(device)
    return distinct


def shared_out(devices: list[DeviceInfo], number: int, of: int) -> list[DeviceInfo]:
    """The devices of one of several processes of a machine, which take them in turn.

    Where there are more processes than devices, several have the same one. All see the same order,
    also where each was given the devices in another one.

    Args:
        devices: of all of the processes together.
        number: of the process, from 0 on.
        of: how many processes there are.
    """
    if of == 1:
        return devices
    ordered = sorted(devices, key=lambda d: (d.hardware.pci or (), d.index))
    return ordered[number::of] or [ordered[number % len(ordered)]]


def matches(selector: str, device: DeviceInfo) -> bool:
    """Whether a selector is a part of a device's name, type or platform ('pocl' counts)."""
    alias = " pocl" if is_pocl(device.platform) else ""
    names = f"{device.name} {device.platform} {device.type}{alias}"
    return bool(selector) and selector.lower() in names.lower()


def usable_memory(chosen: DeviceInfo) -> int:
    """How many bytes of buffers a device may hold by default.

    That is nine tenths of a GPU's memory. A CPU shares its memory with all other programs, so
    there it is half of what is available now.
    """
    if chosen.type == "GPU":
        return chosen.memory * 9 // 10
    available = available_memory()
    return min(chosen.memory, available // 2) if available else chosen.memory
