"""Identifies what affects pixels besides the request: the program, its libraries, the device.

The version alone does not identify a program, because people install from a checkout. Sidecars
therefore contain a digest of it, by which a run recognizes pictures that another program made.
"""

import hashlib
import json
import os
import platform
from collections.abc import Iterator
from functools import cache
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np

from clpipe.base.about import full_version
from clpipe.engine.device import Device
from clpipe.engine.sources import kernel_folder
from clpipe.images.write import versions
from clpipe.outputs.sidecar import CachedJson

# Packages that never affect a pixel: they request pictures, or read finished ones.
WITHOUT_PIXELS = ("analysis", "commands", "dataset", "explorer", "reports", "scenes", "schemas")
IGNORED = (".pyc", ".typed")


@cache
def program_digest() -> str:
    """Return the digest of this program: its modules, kernels, data and image libraries.

    The digest has 64 hexadecimal digits. It takes about 20 ms, once in each process.
    """
    libraries = {**versions(), "numpy": np.__version__}
    parts = [_content(_folders()), json.dumps(libraries, sort_keys=True)]
    return hashlib.sha256("\0".join(parts).encode()).hexdigest()


def _folders() -> list[Path]:
    return [Path(__file__).parents[1], kernel_folder()]


def _content(folders: list[Path]) -> str:
    """Return the digest of the names and contents of all files in folders."""
    digest = hashlib.sha256()
    for folder in folders:
        for path in sorted(_files(folder)):
            data = path.read_bytes()
            name = path.relative_to(folder).as_posix()
            digest.update(f"{name}\0{len(data)}\0".encode() + data)
    return digest.hexdigest()


def _files(folder: Path) -> Iterator[Path]:
    """Yield the files below a folder that may affect pixels."""
    for place, folders, names in os.walk(folder):
        at_top = Path(place) == folder
        folders[:] = [
            name
            for name in folders
            if name != "__pycache__" and not (at_top and name in WITHOUT_PIXELS)
        ]
        yield from (Path(place, name) for name in names if not name.endswith(IGNORED))


def device_record(device: Device | None) -> dict[str, Any]:
    """Return a sidecar's entry for a device, as JSON values; None is NumPy."""
    return {
        "name": device.info.name if device else "numpy",
        "platform": device.info.platform if device else "numpy",
        "version": device.info.version if device else all_versions()["numpy"],
        "driver": device.info.driver if device else "",
        "lanes": device.info.lanes if device else 0,
        "target": device.info.target.name if device else "",
    }


@cache
def all_versions() -> dict[str, str]:
    """Return the versions of all software that a picture's bytes may depend on, by name."""
    return CachedJson(
        clpipe=full_version(),
        python=platform.python_version(),
        numpy=version("numpy"),
        pyopencl=version("pyopencl"),
        **versions(),
    )
