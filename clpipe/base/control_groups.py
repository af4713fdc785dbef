"""The control groups of this process (Linux, version 1 or 2), which limit memory and processors.

Version 1 and version 2 use different file names.
"""

from functools import lru_cache
from pathlib import Path


def group_folders(controller: str, root: Path) -> tuple[tuple[Path, bool], ...]:
    """Return the folders of this process's control groups and of their parents, for a controller.

    Args:
        controller: "memory" or "cpu".
        root: the root of the file system; tests use another one.

    Returns:
        Each folder, and whether its group is of version 1.
    """
    try:
        with open(f"{root}/proc/self/cgroup", encoding="utf-8") as file:
            return _folders(file.read(), controller, root)
    except OSError:
        return ()


@lru_cache(maxsize=4)  # memory is asked for often, and groups rarely change
def _folders(groups: str, controller: str, root: Path) -> tuple[tuple[Path, bool], ...]:
    """Return the folders for the contents of a process's file ``cgroup``."""
    found: list[tuple[Path, bool]] = []
    for line in groups.splitlines():
        _, controllers, path = line.split(":", 2)
        if controllers and controller not in controllers.split(","):
            continue
        mount = root / "sys/fs/cgroup" / (controller if controllers else "")
        own = mount / path.lstrip("/")
        for folder in (own, *own.parents):
            found.append((folder, bool(controllers)))
            if folder == mount:
                break
    return tuple(found)
