"""How many processors this process may use."""

from pathlib import Path

from clpipe.base.control_groups import group_folders
from clpipe.base.system import processors


def available_processors(root: Path = Path("/")) -> int:
    """Return the number of processors that this process may use, within its groups' quotas.

    A quota of one and a half counts as two.

    Args:
        root: the root of the file system; tests use another one.
    """
    quotas = [quota for quota in (_quota(*group) for group in group_folders("cpu", root)) if quota]
    return max(min([processors(), *quotas]), 1)


def _quota(folder: Path, is_first_version: bool) -> int | None:
    """Return the number of processors that a group may use; None without a limit."""
    try:
        if is_first_version:
            names = ("cpu.cfs_quota_us", "cpu.cfs_period_us")
            quota, period = (int((folder / name).read_text()) for name in names)
        else:
            quota, period = map(int, (folder / "cpu.max").read_text().split())
    except (OSError, ValueError):  # the file is missing, or contains "max", which means no limit
        return None
    return -(-quota // period) if quota > 0 and period > 0 else None
