"""Chooses the CPU for which pip's PoCL compiles, by the features of the processor.

PoCL up to version 4 compiles for the CPU name that LLVM reports. LLVM 14, in pip's PoCL 3.0, calls
an AMD Zen 5 "generic", for which nothing compiles. It takes some CPUs for ones without AVX-512 or
AVX. It also ignores that a hypervisor masks features, so that launches end in SIGILL (PoCL's issue
1049).

This module acts only on x86-64 Linux, for a PoCL below 5 that names a CPU with other features than
the processor has. It then replaces the pointer to the CPU name in PoCL's device record, because no
option can change the name. The device's version contains the target triple and the CPU name. The
module acts only if two adjacent pointers to these texts exist exactly once in the record. It uses
/proc/self/mem, where a wrong address causes an error, not a crash. To switch this off, set
``CLPIPE_CPU_TARGET=driver``.
"""

import ctypes
import os
import platform as this_system
import re
import struct
from dataclasses import dataclass
from functools import cache
from itertools import pairwise
from pathlib import Path
from typing import Any

from clpipe.base.errors import DeviceError
from clpipe.base.text import unknown_name

VARIABLE = "CLPIPE_CPU_TARGET"  # forces a target, for tests and support
DRIVER_CHOICE = "driver"  # the value that keeps the driver's choice

_AVX2 = frozenset({"avx2", "fma", "f16c", "bmi1", "bmi2", "abm", "cx16", "popcnt"})
_AVX512 = frozenset({"avx512f", "avx512bw", "avx512dq", "avx512cd", "avx512vl"})
# The targets of PoCL 5 and later, the widest first, with the features that each needs, as named by
# Linux. PoCL's built-in library, which is linked to every kernel, has the same targets.
TARGETS: dict[str, frozenset[str]] = {
    "skx": _AVX2 | _AVX512,
    "haswell": _AVX2,
    "ivybridge": frozenset({"avx", "f16c"}),
    "sandybridge": frozenset({"avx"}),
    "penryn": frozenset({"sse4_1"}),
    "core2": frozenset({"ssse3"}),
    "x86-64": frozenset(),
}
# LLVM's names for CPUs with the same vector features as a target.
EQUIVALENT_CPUS = {
    "skx": (
        "skylake-avx512",
        "cascadelake",
        "cooperlake",
        "cannonlake",
        "icelake-client",
        "icelake-server",
        "tigerlake",
        "rocketlake",
        "sapphirerapids",
        "emeraldrapids",
        "graniterapids",
        "graniterapids-d",
        "znver4",
        "znver5",
        "x86-64-v4",
    ),
    "haswell": (
        *("broadwell", "skylake", "alderlake", "raptorlake", "meteorlake", "arrowlake"),
        *("arrowlake-s", "lunarlake", "gracemont", "sierraforest", "x86-64-v3"),
        *("bdver4", "znver1", "znver2", "znver3"),
    ),
    "ivybridge": ("core-avx-i", "bdver2", "bdver3", "btver2"),
    "sandybridge": ("corei7-avx", "bdver1"),
    "penryn": ("nehalem", "westmere", "silvermont", "goldmont", "goldmont-plus", "tremont"),
    "core2": ("bonnell",),
}
RECORD_BYTES = 1200  # bytes of the device record to search; in PoCL 3.0 the pointer is at 640
_texts: dict[int, ctypes.Array[ctypes.c_char]] = {}  # names set, by device; PoCL points to them


@dataclass(frozen=True)
class Target:
    """The CPU for which a runtime compiles.

    Args:
        name: LLVM's name of the CPU; "" if the runtime does not report it.
        reason: why this CPU was chosen, in words.
    """

    name: str
    reason: str

    @property
    def is_wide(self) -> bool:
        """Whether the CPU has vector registers of 512 bits."""
        return equivalent_target(self.name) == "skx"


def equivalent_target(name: str) -> str | None:
    """Return the one of :data:`TARGETS` with a CPU's features; None for an unknown name."""
    if name in TARGETS:
        return name
    return next((target for target, names in EQUIVALENT_CPUS.items() if name in names), None)


def target_for(features: frozenset[str]) -> str:
    """Return the widest of :data:`TARGETS` whose features, as named by Linux, are all present.

    >>> target_for(frozenset({"sse4_1", "avx", "f16c", "avx512f"}))
    'ivybridge'
    """
    return next(name for name, needed in TARGETS.items() if needed <= features)


# The leaf, register and bit of each required feature, from glibc's <sys/platform/x86.h>.
_CPUID_BITS = {
    "ssse3": (0, 2, 9),
    "fma": (0, 2, 12),
    "cx16": (0, 2, 13),
    "sse4_1": (0, 2, 19),
    "popcnt": (0, 2, 23),
    "avx": (0, 2, 28),
    "f16c": (0, 2, 29),
    "bmi1": (1, 1, 3),
    "avx2": (1, 1, 5),
    "bmi2": (1, 1, 8),
    "avx512f": (1, 1, 16),
    "avx512dq": (1, 1, 17),
    "avx512cd": (1, 1, 28),
    "avx512bw": (1, 1, 30),
    "avx512vl": (1, 1, 31),
    "abm": (2, 2, 5),
}


CPUINFO = Path("/proc/cpuinfo")


@cache
def cpu_text() -> str:
    """Return the vendor, model and features of this CPU as Linux lists them, or ""."""
    try:
        lines = CPUINFO.read_text("utf-8").splitlines()
    except (OSError, UnicodeDecodeError):
        return ""
    keys = ("vendor", "cpu family", "model", "flags", "CPU ", "Features")
    return "\n".join(dict.fromkeys(line for line in lines if line.startswith(keys)))


@cache
def cpu_features() -> frozenset[str] | None:
    """Return the features of this x86-64 CPU that programs may use; None if they are unknown.

    A feature must be listed by Linux and usable according to glibc (2.33 and later), as far as each
    source is available. Linux alone is not enough: emulators and containers pass on the host's
    list, which may contain features that are missing here.
    """
    if this_system.machine() not in ("x86_64", "AMD64"):
        return None
    found = [features for features in (_listed(), _usable()) if features is not None]
    return frozenset.intersection(*found) if found else None


def _listed() -> frozenset[str] | None:
    """Return the features that Linux lists for all processors."""
    lines = re.findall(r"^flags\s*:(.*)$", cpu_text(), re.MULTILINE)
    return frozenset.intersection(*(frozenset(line.split()) for line in lines)) if lines else None


def _usable() -> frozenset[str] | None:
    """Return the features that glibc found usable; None without a suitable glibc."""
    try:
        query = ctypes.CDLL(None).__x86_get_cpuid_feature_leaf
    except (OSError, AttributeError, TypeError):
        return None
    # struct cpuid_feature: the CPU's features, then the active ones, each in EAX to EDX.
    query.restype = ctypes.POINTER(ctypes.c_uint32 * 8)
    query.argtypes = [ctypes.c_uint32]
    active = {
        leaf: list(query(leaf).contents)[4:] for leaf in {leaf for leaf, *_ in _CPUID_BITS.values()}
    }
    return frozenset(
        name
        for name, (leaf, register, bit) in _CPUID_BITS.items()
        if active[leaf][register] >> bit & 1
    )


def forced_target() -> str | None:
    """Return the target that :data:`VARIABLE` names, or :data:`DRIVER_CHOICE`; None if unset.

    Raises:
        DeviceError: the variable names an unknown target.
    """
    name = os.environ.get(VARIABLE) or None
    if name and name not in (*TARGETS, DRIVER_CHOICE):
        raise DeviceError(f"{VARIABLE}: {unknown_name('target', name, (*TARGETS, DRIVER_CHOICE))}")
    return name


def driver_target(version: str) -> tuple[str, str] | None:
    """Return the target triple and the CPU that PoCL on Linux chooses, from its device's version.

    Returns:
        None if the version names no CPU. Debian's PoCL for arm64 has "(null)", because it compiles
        for all CPUs.

    >>> driver_target("OpenCL 3.0 PoCL HSTR: pthread-x86_64-unknown-linux-gnu-znver3")
    ('x86_64-unknown-linux-gnu', 'znver3')
    """
    match = re.search(r"HSTR: \w+-((?:\w+-){1,2}linux-(?:gnu|musl))-(\w\S*)", version)
    return (match[1], match[2]) if match else None


def candidates(platform: Any, device: Any) -> list[Target]:
    """Return the targets to try for a device, in order; see :func:`compile_for`.

    Args:
        platform: a ``pyopencl.Platform``.
        device: one of its devices.

    Raises:
        DeviceError: :data:`VARIABLE` names an unknown target.
    """
    forced = forced_target()
    triple_and_cpu = (
        driver_target(device.version) if "Portable Computing" in platform.name else None
    )
    if triple_and_cpu is None:
        return [Target("", "the driver's choice")]
    driver_cpu = triple_and_cpu[1]
    features = cpu_features()
    if features is None or not _uses_llvm_name(platform.version) or _name_pointer(device) is None:
        return [
            Target(driver_cpu, f"PoCL's choice{f'; {VARIABLE} cannot change it' if forced else ''}")
        ]
    if forced == DRIVER_CHOICE:
        return [Target(driver_cpu, f"PoCL's choice, set by {VARIABLE}")]
    if forced:
        return [Target(forced, f"set by {VARIABLE}")]
    target = target_for(features)
    if equivalent_target(driver_cpu) == target:
        return [Target(driver_cpu, "PoCL's choice, which matches the CPU's features")]
    failed = f"because {target}, which matches the CPU's features, does not work"
    return [
        Target(target, f"from the CPU's features; PoCL's choice is {driver_cpu}"),
        *([] if driver_cpu == "generic" else [Target(driver_cpu, f"PoCL's choice, {failed}")]),
        Target("x86-64", f"works on every such CPU, {failed}"),
    ]


def compile_for(device: Any, target: Target) -> None:
    """Make a ``pyopencl.Device`` compile for one of its :func:`candidates`.

    This applies to everything compiled from now on, in all contexts of this process.
    """
    triple_and_cpu = driver_target(device.version)
    set_before = _texts.get(device.int_ptr)
    current = set_before.value.decode() if set_before else triple_and_cpu and triple_and_cpu[1]
    pointer = _name_pointer(device)
    if pointer is None or target.name == current:
        return
    text = ctypes.create_string_buffer(target.name.encode())
    with open("/proc/self/mem", "r+b", buffering=0) as memory:
        os.pwrite(memory.fileno(), struct.pack("Q", ctypes.addressof(text)), pointer)
    _texts[device.int_ptr] = text


def _uses_llvm_name(version: str) -> bool:
    """Return whether a PoCL with this platform version uses LLVM's name for the CPU."""
    found = re.search(r"PoCL (\d+)\.", version, re.IGNORECASE)
    return found is not None and int(found[1]) < 5


def _name_pointer(device: Any) -> int | None:
    """Return the address of the pointer to the CPU name; None if it cannot be found for certain."""
    triple_and_cpu = driver_target(device.version)
    if triple_and_cpu is None:
        return None
    replaced = _texts.get(device.int_ptr)
    triple = triple_and_cpu[0].encode() + b"\0"
    cpu = (replaced.value if replaced else triple_and_cpu[1].encode()) + b"\0"
    try:
        with open("/proc/self/mem", "rb", buffering=0) as memory:
            descriptor = memory.fileno()
            record = _read_memory(descriptor, device.int_ptr, RECORD_BYTES)
            words = struct.unpack_from(f"{len(record) // 8}Q", record)
            pointers = [
                device.int_ptr + 8 * (i + 1)
                for i, (first, second) in enumerate(pairwise(words))
                if _read_memory(descriptor, second, len(cpu)) == cpu
                and _read_memory(descriptor, first, len(triple)) == triple
            ]
    except OSError:
        return None
    return pointers[0] if len(pointers) == 1 else None


def _read_memory(memory: int, address: int, size: int) -> bytes:
    """Return bytes of this process's memory; fewer if not all can be read."""
    if not 4096 <= address < 2**47:
        return b""
    try:
        return os.pread(memory, size, address)
    except OSError:
        return b""
