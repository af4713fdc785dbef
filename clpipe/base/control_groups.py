"""The control groups of this process (Linux, version 1 or 2), which limit memory and processors.

Version 1 and version 2 use different file names.
"""

from collections.abc import Iterator
from pathlib import Path


def group_folders(controller: str, root: Path) -> Iterator[tuple[Path, bool]]:
    """Yield the folders of this process's control groups and of their parents, for a controller.

    Args:
        controller: "memory" or "cpu".
        root: the root of the file system; tests use another one.

    Yields:
        Each folder, and whether its group is of version 1.
    """
    try:
        lines = (root / "proc/self/cgroup").read_text().splitlines()
    except OSError:
        return
    for line in lines:
        _, controllers, path = line.split(":", 2)
        if controllers and controller not in controllers.split(","):
            continue
        mount = root / "sys/fs/cgroup" / (controller if controllers else "")
        own = mount / path.lstrip("/")
        for folder in (own, *own.parents):
            yield folder, bool(controllers)
            if folder == mount:
                break
