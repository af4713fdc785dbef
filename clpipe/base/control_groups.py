"""The control groups of this process (Linux, version 1 or 2), which limit memory and processors."""

from collections.abc import Iterator
from pathlib import Path


def group_folders(controller: str, root: Path) -> Iterator[tuple[Path, bool]]:
    """The folders of this process's groups of a controller and of the groups above them.

    With each comes whether it is of version 1, whose files have other names.
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
