"""Memory sizes as text, and the free memory of this machine."""

import re
from dataclasses import dataclass
from mmap import mmap
from pathlib import Path
from typing import Any

from clpipe.base.control_groups import group_folders
from clpipe.base.errors import DeviceError, RequestError
from clpipe.base.system import max_address_space

UNITS = {"": 1, "K": 2**10, "M": 2**20, "G": 2**30, "T": 2**40}
MADV_DONTNEED = 4  # Linux; mmap has the constant only there
NO_LIMIT = 2**60  # bytes; without a limit, groups of version 1 report the largest page count


def release_pages(array: Any) -> None:
    """Release the memory of an array that NumPy mapped from a file; its values stay in the file.

    The system reads them again when they are used. Without this, memory would hold all of a file
    that is larger than the memory. Other arrays do not change.
    """
    is_shared = False  # with the file; changes of a private mapping are only in memory
    while array is not None and not isinstance(array, mmap):
        is_shared |= getattr(array, "mode", "") in ("r", "r+", "w+")
        array = getattr(array, "base", None)
    if is_shared and isinstance(array, mmap) and hasattr(array, "madvise"):
        array.madvise(MADV_DONTNEED)


def parse_size(text: str) -> int:
    """Convert a size such as 4G to bytes. The units K, M, G and T are powers of 1024.

    >>> parse_size("512M"), parse_size("1.5 GiB"), parse_size("4096")
    (536870912, 1610612736, 4096)

    Raises:
        RequestError: the text is not a size, or the size is 0 or does not fit into 63 bits.
    """
    match = re.fullmatch(r"(\d+\.?\d*|\.\d+)\s*([kmgt]?)(?:i?b)?", text.strip(), re.IGNORECASE)
    size = float(match[1]) * UNITS[match[2].upper()] if match else 0
    if not 1 <= size < 2**63:
        raise RequestError(f"--memory: '{text}' is not a size. Use a size such as 512M or 8G.")
    return int(size)


def format_bytes(size: float) -> str:
    """Return a number of bytes as text, rounded to a tenth of a KiB, MiB or GiB.

    >>> format_bytes(8.2 * 2**30), format_bytes(5_000_000), format_bytes(1000)
    ('8.2 GiB', '4.8 MiB', '1.0 KiB')
    """
    for unit in ("GiB", "MiB"):
        scale = UNITS[unit[0]]
        if size >= scale:
            return f"{size / scale:.1f} {unit}"
    return f"{size / 1024:.1f} KiB"


@dataclass(frozen=True)
class FreeMemory:
    """How many bytes a process can still allocate, and the limit, in words."""

    bytes: int
    limit: str


def free_memory(root: Path = Path("/")) -> FreeMemory | None:
    """Return the bytes that this process can still allocate, under its tightest limit.

    The limits are MemAvailable, control groups and ``ulimit -v``.

    Args:
        root: the root of the file system; tests use another one.

    Returns:
        The bytes and the limit. None if there is no limit, for example outside Linux.
    """
    limits = [_free_in_machine(root), *_free_in_groups(root), _free_addresses(root)]
    return min(filter(None, limits), key=lambda free: free.bytes, default=None)


def available_memory(root: Path = Path("/")) -> int | None:
    """Return the bytes of :func:`free_memory`."""
    free = free_memory(root)
    return free.bytes if free else None


def check_address_space(needed: int, what: str) -> None:
    """Check that ``ulimit -v`` leaves enough address space. Libraries crash without it.

    Args:
        needed: the required address space in bytes.
        what: what needs it, for the message.

    Raises:
        DeviceError: too little address space is left.
    """
    free = _free_addresses(Path("/"))
    if free and free.bytes < needed:
        raise DeviceError(
            f"{what} needs about {format_bytes(needed)} of address space, but "
            f"only {format_bytes(free.bytes)} is available ({free.limit}). Raise the limit."
        )


def peak_memory(root: Path = Path("/")) -> int | None:
    """Return this process's peak memory in bytes; None outside Linux.

    The system's ru_maxrss is not used, because it includes the peak of the parent process.
    """
    return _proc_value(root / "proc/self/status", "VmHWM")


def _free_in_machine(root: Path) -> FreeMemory | None:
    size = _proc_value(root / "proc/meminfo", "MemAvailable")
    return None if size is None else FreeMemory(size, "this machine's memory")


def _free_addresses(root: Path) -> FreeMemory | None:
    """Return the address space left under ``ulimit -v``, which also counts reserved memory."""
    limit, used = max_address_space(), _proc_value(root / "proc/self/status", "VmSize")
    if limit is None or used is None:
        return None
    return FreeMemory(max(limit - used, 0), f"ulimit -v, which is {format_bytes(limit)}")


def _proc_value(path: Path, name: str) -> int | None:
    """Return the bytes of an entry in a file of /proc, whose values are in KiB."""
    try:
        match = re.search(rf"^{name}:\s+(\d+) kB", path.read_text("utf-8"), re.MULTILINE)
    except OSError:
        return None
    return int(match[1]) * 1024 if match else None


def _free_in_groups(root: Path) -> list[FreeMemory | None]:
    """Return the memory left in each control group of this process and in the groups' parents."""
    first = ("memory.limit_in_bytes", "memory.usage_in_bytes", "total_{}_file", "total_mapped_file")
    second = ("memory.max", "memory.current", "{}_file", "file_mapped")
    return [
        _free_in_group(folder, *(first if is_first_version else second))
        for folder, is_first_version in group_folders("memory", root)
    ]


def _free_in_group(
    folder: Path, limit: str, used: str, cached: str, mapped: str
) -> FreeMemory | None:
    """Return the memory left in one group; None without a limit.

    Cached files count as free, because the system can drop them, unless they are mapped.
    """
    try:
        maximum = int((folder / limit).read_text("utf-8"))
        if maximum >= NO_LIMIT:
            return None
        remaining = maximum - int((folder / used).read_text("utf-8"))
        lines = (folder / "memory.stat").read_text("utf-8").splitlines()
    except (OSError, ValueError):  # the file is missing, or contains "max", which means no limit
        return None
    values = {name: int(value) for name, _, value in (line.partition(" ") for line in lines)}
    both = (values.get(cached.format(state), 0) for state in ("active", "inactive"))
    files = max(sum(both) - values.get(mapped, 0), 0)
    return FreeMemory(
        max(remaining + files, 0), f"its control group's limit, which is {format_bytes(maximum)}"
    )
