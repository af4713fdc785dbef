"""Finds the OpenCL devices of this machine, and chooses which to use."""

import os
import platform as this_system
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from clpipe.base.errors import DeviceError
from clpipe.base.extras import install_command
from clpipe.base.memory import available_memory, check_address_space
from clpipe.base.system import processors
from clpipe.base.text import unknown_name
from clpipe.engine.cache_folder import pocl_problem
from clpipe.engine.cpu_target import VARIABLE as TARGET_VARIABLE
from clpipe.engine.cpu_target import Target, candidates, compile_for, forced_target
from clpipe.engine.hardware import Hardware, hardware_of, private_cache
from clpipe.engine.ir import Cpu
from clpipe.engine.runtimes import (
    attempt,
    device_problem,
    is_pocl,
    lanes_for,
    needs_test,
    platform_id,
    type_of,
)
from clpipe.engine.vendors import platforms, unloadable_drivers
from clpipe.engine.verdicts import Verdicts, verdicts

# Bytes of address space: of PoCL while it compiles, and of one thread per processor.
POCL_ADDRESS_SPACE = 256 << 20
THREAD_ADDRESS_SPACE = 8 << 20

NO_TARGET = Target("", "")
TYPES = ("GPU", "CPU")  # selectors that demand a type of device

_process: int | None = None  # the process id that first used OpenCL, here or before a fork


@dataclass(frozen=True)
class DeviceInfo:
    """A device of an OpenCL platform. ``problem`` is the reason why it is unusable, or ""."""

    index: int
    platform: str
    problem: str
    hardware: Hardware
    version: str  # of OpenCL, as reported by the device
    # The defaults are those of a platform without devices.
    name: str = "no device"
    type: str = "none"  # "GPU", "CPU", "emulator" or "accelerator"
    driver: str = ""
    compute_units: int = 0
    memory: int = 0  # bytes
    max_buffer: int = 0  # bytes
    lanes: int = 0
    target: Target = NO_TARGET  # the CPU for which kernels are compiled
    handle: Any = None

    @property
    def label(self) -> str:
        """The device's name and platform."""
        return f"{self.name.strip()} ({self.platform})"

    @property
    def zero_copy(self) -> bool:
        """Whether kernels use the host's memory directly and at full speed."""
        return self.type == "CPU" and bool(self.handle.host_unified_memory)

    @property
    def cpu(self) -> Cpu | None:
        """The CPU on which launches run in bands; None for a device without vector lanes."""
        return Cpu(self.compute_units, private_cache()) if self.lanes > 1 else None

    @property
    def alignment(self) -> int:
        """The alignment, in bytes, of host memory that kernels use directly.

        Intel's runtime copies unaligned memory, five times slower than clpipe does. PoCL accepts
        any address.
        """
        return 1 if is_pocl(self.platform) else self.handle.mem_base_addr_align // 8


def check_process(process: int | None) -> None:
    """Check that no fork separates this process from the one that used OpenCL.

    Args:
        process: the id of that process; None if none has used it.

    Raises:
        DeviceError: this process was forked from that one.
    """
    if process not in (None, os.getpid()):
        raise DeviceError(
            "this process was forked from one that had used OpenCL, so OpenCL would hang here. "
            'Use multiprocessing\'s "spawn" or "forkserver", or fork before OpenCL is used.'
        )


def find_devices(retest: bool = False) -> list[DeviceInfo]:
    """Return every device of every OpenCL platform, in the platforms' order. Each is tested once.

    Args:
        retest: whether to repeat failed tests.

    Raises:
        DeviceError: pyopencl cannot be loaded, this process cannot use it, or the address space is
            too small.
    """
    global _process
    check_process(_process)
    check_address_space(
        POCL_ADDRESS_SPACE + THREAD_ADDRESS_SPACE * processors(), "an OpenCL runtime"
    )
    _process = os.getpid()
    forced_target()
    known = verdicts(retest)
    if known.listing:
        raise DeviceError(f"OpenCL's drivers cannot be listed: {known.listing}. {runtime_advice()}")
    found: list[DeviceInfo] = []
    for platform in platforms(known.hidden):
        devices, reason = devices_of(platform, known)
        for device in devices:
            is_new = known.of(platform, device) is None
            if is_new and needs_test(type_of(platform, device), platform, device):
                known = verdicts(
                    missing=[attempt(platform, device, candidates(platform, device)[0])]
                )
            found.append(describe(len(found), platform, device, known))
        if not devices:
            handle, version = platform.int_ptr, platform.version
            found.append(empty_platform(len(found), platform.name, reason, version, handle))
    for name, reason in known.hidden.items():
        found.append(empty_platform(len(found), name, reason))
    return found


def devices_of(platform: Any, known: Verdicts) -> tuple[list[Any], str]:
    """Return the devices of a ``pyopencl.Platform``, and the reason if there are none."""
    import pyopencl as cl

    if reason := known.platforms.get(platform_id(platform)):
        return [], f"when asked for its devices, {reason}"
    problem = pocl_problem() if is_pocl(platform.name) else ""
    try:
        return list(platform.get_devices()), problem or "it offers no device"
    except cl.Error as error:
        return [], problem or f"it offers no device: {error}"


def describe(index: int, platform: Any, device: Any, known: Verdicts) -> DeviceInfo:
    """Return the description of a ``pyopencl.Device``, and make it compile for its target."""
    type_ = type_of(platform, device)
    problem = device_problem(type_, platform, device)
    target = candidates(platform, device)[0]
    if not problem and (verdict := known.of(platform, device)):
        target, problem = verdict
    compile_for(device, target)
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
        lanes=lanes_for(type_, platform, device, target),
        target=target,
        problem=problem,
        handle=device,
        hardware=hardware_of(device),
    )


def empty_platform(
    index: int, platform: str, reason: str, version: str = "", handle: int = 0
) -> DeviceInfo:
    """Return an entry for an installed platform without devices, which contains the reason."""
    return DeviceInfo(index, platform.strip(), reason, Hardware(handle), version.strip())


def runtime_advice() -> str:
    """Return advice for a machine on which no OpenCL runtime works."""
    linux = this_system.system() == "Linux"
    x86 = this_system.machine() in ("x86_64", "AMD64")
    ways = [
        "your GPU's driver",
        *([install_command("intel-opencl-rt", "intel-cmplr-lib-rt")] if linux and x86 else []),
        *(["apt-get install pocl-opencl-icd (Debian, Ubuntu)"] if linux else []),
    ]
    if name := forced_target():
        ways.insert(0, f"unset {TARGET_VARIABLE} (it is {name})")
    return (
        f"On this machine, try: {', or '.join(ways)}. "
        "To run without OpenCL, use --device numpy, which is slow."
    )


def choose(selector: str | None, devices: list[DeviceInfo]) -> DeviceInfo:
    """Return the device that a selector names, or by default the usable device of least rank.

    Args:
        selector: an index from ``clpipe devices``, "gpu" or "cpu", or a part of a device's or
            platform's name. None is the default.
        devices: the devices of this machine.

    Raises:
        DeviceError: there is no device, none matches, or the matching one cannot be used.
    """
    if not devices:
        variables = ("OCL_ICD_VENDORS", "OCL_ICD_FILENAMES")  # they limit the loader's search
        limits = "".join(f" ({n} is {os.environ[n]!r})" for n in variables if n in os.environ)
        raise DeviceError(f"no OpenCL platform was found{limits}. {runtime_advice()}")
    if selector is not None:
        matching = [
            d
            for d in devices
            if (selector == str(d.index) if selector.isdecimal() else matches(selector, d))
        ]
        if not matching and selector.upper() in TYPES:
            broken = "".join(f" {p}: {reason}." for p, reason in unloadable_drivers().items())
            driver = "the GPU's driver" if selector.upper() == "GPU" else "an OpenCL runtime"
            raise DeviceError(
                f"no OpenCL runtime offers a {selector.upper()}.{broken} Install {driver}, or "
                "choose another device. To list all, run clpipe devices."
            )
        if not matching:
            names = [f"{d.index}: {d.label}" for d in devices]
            raise DeviceError(unknown_name("device", selector, [*names, "numpy"]))
        usable = [d for d in matching if not d.problem]
        if not usable:
            raise DeviceError(
                f"device {matching[0].label}: {matching[0].problem}. To find another one, run "
                "clpipe devices."
            )
        return min(usable, key=rank)
    usable = [d for d in devices if d.type in ("GPU", "CPU") and not d.problem]
    if not usable:
        reasons = "; ".join(f"{d.label}: {d.problem or 'an emulator'}" for d in devices)
        raise DeviceError(f"no usable OpenCL device ({reasons}). {runtime_advice()}")
    return min(usable, key=rank)


def rank(device: DeviceInfo) -> int:
    """Return a device's rank as default: first GPUs, then CPUs in the order of platform speed."""
    if device.type == "GPU":
        return 0
    if "Intel" in device.platform:
        return 1
    return 2 if is_pocl(device.platform) else 3


def choose_all(selectors: Sequence[str], devices: list[DeviceInfo]) -> list[DeviceInfo]:
    """Return the devices that selectors name; each selector is one of :func:`choose`.

    Without selectors, these are the default device and, if it is a GPU, all other GPUs of the same
    name, because these give the same bits. Each device is listed once, even if two drivers offer
    it.

    Raises:
        DeviceError: as for :func:`choose`.
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


def devices_of_process(devices: list[DeviceInfo], index: int, count: int) -> list[DeviceInfo]:
    """Return the devices of one of several processes of a machine, distributed round-robin.

    If there are more processes than devices, several processes share a device. The distribution
    does not depend on the order of ``devices``.

    Args:
        devices: the devices of all processes together.
        index: the number of the process, from 0.
        count: the number of processes.
    """
    if count == 1:
        return devices
    ordered = sorted(devices, key=lambda d: (d.hardware.pci or (), d.index))
    return ordered[index::count] or [ordered[index % len(ordered)]]


def matches(selector: str, device: DeviceInfo) -> bool:
    """Return whether a selector is a device's type, a part of its name or platform, or "pocl"."""
    if selector.upper() in TYPES:
        return device.type == selector.upper()
    alias = " pocl" if is_pocl(device.platform) else ""
    names = f"{device.name} {device.platform} {device.type}{alias}"
    return bool(selector) and selector.lower() in names.lower()


def usable_memory(device: DeviceInfo) -> int:
    """Return the default limit for a device's buffers in bytes.

    It is nine tenths of a GPU's memory. A CPU shares its memory with all other programs, so there
    it is at most half of the memory that is available now.
    """
    if device.type == "GPU":
        return device.memory * 9 // 10
    available = available_memory()
    return min(device.memory, available // 2) if available else device.memory
