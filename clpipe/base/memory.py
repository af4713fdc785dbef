"""Amounts of memory: parsed from text, formatted as text, and how much is free on this machine."""

import re
from pathlib import Path

from clpipe.base.control_groups import group_folders
from clpipe.base.errors import RequestError

UNITS = {"": 1, "K": 2**10, "M": 2**20, "G": 2**30, "T": 2**40}


def parse_size(text: str) -> int:
    """Bytes, from a number with a unit: K, M, G or T, in powers of 1024.

    >>> parse_size("512M"), parse_size("1.5 GiB"), parse_size("4096")
    (536870912, 1610612736, 4096)

    Raises:
        RequestError: the text is not a size, or the size is 0 or beyond 63 bits.
    """
    match = re.fullmatch(r"(\d+\.?\d*|\.\d+)\s*([kmgt]?)(?:i?b)?", text.strip(), re.IGNORECASE)
    size = float(match[1]) * UNITS[match[2].upper()] if match else 0
    if not 1 <= size < 2**63:
        raise RequestError(f"--memory: found '{text}'; expected a size such as 512M or 8G")
    return int(size)


def in_words(size: float) -> str:
    """A number of bytes as text, rounded to a tenth of KiB, MiB or GiB.

    >>> in_words(8.2 * 2**30), in_words(5_000_000), in_words(1000)
    ('8.2 GiB', '4.8 MiB', '1.0 KiB')
    """
    for unit in ("GiB", "MiB"):
        scale = UNITS[unit[0]]
        if size >= scale:
            return f"{size / scale:.1f} {unit}"
    return f"{size / 1024:.1f} KiB"


def available_memory(root: Path = Path("/")) -> int | None:
    """Bytes that this process can still allocate: the least of MemAvailable and its cgroup limits.

    None where the system gives neither, as outside Linux. ``root`` is for tests.
    """
    limits = [_available(root / "proc/meminfo"), *_left_in_groups(root)]
    return min((size for size in limits if size is not None), default=None)


def peak_memory(root: Path = Path("/")) -> int | None:
    """The most bytes that this process has held at a time; None outside Linux.

    The system's ru_maxrss goes on from the process that started this one.
    """
    return _listed(root / "proc/self/status", "VmHWM")


def _available(meminfo: Path) -> int | None:
    return _listed(meminfo, "MemAvailable")


def _listed(path: Path, name: str) -> int | None:
    """The bytes of an entry of one of the system's lists, which has KiB."""
    try:
        match = re.search(rf"^{name}:\s+(\d+) kB", path.read_text("utf-8"), re.MULTILINE)
    except OSError:
        return None
    return int(match[1]) * 1024 if match else None


def _left_in_groups(root: Path) -> list[int | None]:
    """Bytes left in each control group of this process and in its parents."""
    first = ("memory.limit_in_bytes", "memory.usage_in_bytes")
    second = ("memory.max", "memory.current")
    return [
        _left_in_group(folder, *(first if is_first_version else second))
        for folder, is_first_version in group_folders("memory", root)
    ]


def _left_in_group(folder: Path, limit: str, used: str) -> int | None:
    """Bytes left in one group; None without a limit. Cached files count as free: they can go."""
    try:
        rest = int((folder / limit).read_text("utf-8")) - int((folder / used).read_text("utf-8"))
        files = re.search(
            r"^inactive_file (\d+)", (folder / "memory.stat").read_text("utf-8"), re.MULTILINE
        )
    except (OSError, ValueError):  # not there, or "max": no limit
        return None
    return max(rest + (int(files[1]) if files else 0), 0)
