"""Identifies the hardware of a device, because two OpenCL drivers may offer the same hardware."""

import ctypes
import struct
from contextlib import suppress
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

# pyopencl has no names for these (cl_khr_pci_bus_info, cl_khr_device_uuid).
PCI_BUS_INFO, UUID = 0x410F, 0x106A


CACHES = Path("/sys/devices/system/cpu/cpu0/cache")
USUAL_CACHE = 512 << 10  # bytes; of a Zen 3 core


@cache
def private_cache(folder: Path = CACHES) -> int:
    """Return the bytes of the second-level cache of a core, from Linux, or a usual size."""
    for index in sorted(folder.glob("index*")):
        with suppress(OSError, ValueError):
            if (index / "level").read_text("ascii").strip() == "2":
                return int((index / "size").read_text("ascii").strip().removesuffix("K")) << 10
    return USUAL_CACHE


@dataclass(frozen=True)
class Hardware:
    """The hardware of a device. Values that the driver does not report are None.

    Args:
        platform: the platform's handle.
        pci: domain, bus, device and function on the PCI bus.
        uuid: the device's UUID, 16 bytes.
    """

    platform: int
    pci: tuple[int, ...] | None = None
    uuid: bytes | None = None

    def is_same(self, other: "Hardware") -> bool:
        """Return whether two devices are the same hardware, as far as their drivers report.

        Two devices of one platform are always different, even if they are on one board.
        """
        if self.platform == other.platform:
            return False
        return any(
            mine is not None and mine == theirs
            for mine, theirs in ((self.pci, other.pci), (self.uuid, other.uuid))
        )


def hardware_of(device: Any) -> Hardware:
    """Return the hardware of a ``pyopencl.Device``."""
    uuid = query_device(device, UUID)
    pci = query_device(device, PCI_BUS_INFO)
    address = struct.unpack("4I", pci) if pci else pci_address(device)
    return Hardware(device.platform.int_ptr, address, uuid)


def query_device(device: Any, name: int, size: int = 16) -> bytes | None:
    """Return a value of clGetDeviceInfo for which pyopencl has no name; None if it is missing."""
    import pyopencl as cl

    try:
        # pyopencl's extension module is linked to the loader, so the function is found through it.
        query = ctypes.CDLL(cl._cl.__file__).clGetDeviceInfo
    except (OSError, AttributeError):
        return None
    value = ctypes.create_string_buffer(size)
    handle = ctypes.c_void_p(device.int_ptr)
    failed = query(handle, ctypes.c_uint(name), ctypes.c_size_t(size), value, None)
    # Drivers leave zeros for an unknown value. Some also do so for a known one.
    return None if failed or not any(value.raw) else value.raw


def pci_address(device: Any) -> tuple[int, ...] | None:
    """Return the PCI address of older NVIDIA and AMD drivers: domain, bus, device, function."""
    import pyopencl as cl

    try:
        slot = device.pci_slot_id_nv  # device and function in one number
        return device.pci_domain_id_nv, device.pci_bus_id_nv, slot >> 3, slot & 7
    except (cl.Error, AttributeError):
        pass
    try:
        topology = device.topology_amd
        return 0, topology.bus, topology.device, topology.function
    except (cl.Error, AttributeError):
        return None
