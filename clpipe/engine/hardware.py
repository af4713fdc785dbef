"""The piece of hardware that a device is: two OpenCL drivers may offer the same one."""

import ctypes
import struct
from dataclasses import dataclass
from typing import Any

# pyopencl has no names for these (cl_khr_pci_bus_info, cl_khr_device_uuid).
PCI_BUS_INFO, UUID = 0x410F, 0x106A


@dataclass(frozen=True)
class Hardware:
    """The hardware of a device, as far as its driver says; None where it does not.

    Args:
        platform: the platform's handle.
        pci: domain, bus, device and function on the PCI bus.
        uuid: 16 bytes.
    """

    platform: int
    pci: tuple[int, ...] | None = None
    uuid: bytes | None = None

    def is_same(self, other: "Hardware") -> bool:
        """Whether two devices are one piece of hardware, as far as their drivers say.

        Two of one platform are two, also where they are parts of one board.
        """
        if self.platform == other.platform:
            return False
        return any(
            mine is not None and mine == theirs
            for mine, theirs in ((self.pci, other.pci), (self.uuid, other.uuid))
        )


def hardware_of(device: Any) -> Hardware:
    """The hardware of a ``pyopencl.Device``."""
    uuid = queried(device, UUID)
    pci = queried(device, PCI_BUS_INFO)
    address = struct.unpack("4I", pci) if pci else vendor_address(device)
    return Hardware(device.platform.int_ptr, address, uuid)


def queried(device: Any, name: int, size: int = 16) -> bytes | None:
    """A value of clGetDeviceInfo that pyopencl has no name for; None where there is none."""
    import pyopencl as cl

    try:
        # The loader that pyopencl uses is one of the libraries that its extension needs.
        query = ctypes.CDLL(cl._cl.__file__).clGetDeviceInfo
    except (OSError, AttributeError):
        return None
    value = ctypes.create_string_buffer(size)
    handle = ctypes.c_void_p(device.int_ptr)
    failed = query(handle, ctypes.c_uint(name), ctypes.c_size_t(size), value, None)
    # Drivers that do not know a number leave zeros, and so do some that do.
    return None if failed or not any(value.raw) else value.raw


def vendor_address(device: Any) -> tuple[int, ...] | None:
    """The PCI address as older drivers of NVIDIA and AMD give it: domain, bus, device, function."""
    import pyopencl as cl

    try:
        slot = device.pci_slot_id_nv  # device and function in one number
        return device.pci_domain_id_nv, device.pci_bus_id_nv, slot >> 3, slot & 7
    except (cl.Error, AttributeError):
        pass
    try:
        place = device.topology_amd
        return 0, place.bus, place.device, place.function
    except (cl.Error, AttributeError):
        return None
