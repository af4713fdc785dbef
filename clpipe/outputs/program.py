"""Which program makes the pictures: a digest of all that decides their pixels, besides the request.

The version does not tell: people install from a checkout. So sidecars have this digest, and what
another program has made is not taken for this one's.
"""

import hashlib
import json
import os
from collections.abc import Iterator
from functools import cache
from pathlib import Path

import numpy as np

import clpipe
from clpipe.engine.cache_folder import cache_folder
from clpipe.engine.sources import kernel_folder
from clpipe.engine.store import Store
from clpipe.images.write import versions

# The rooms in which nothing decides a pixel: they ask for pictures, or look at finished ones.
WITHOUT_PIXELS = ("analysis", "commands", "dataset", "explorer", "reports", "scenes")
IGNORED = (".pyc", ".typed")


@cache
def program_digest() -> str:
    """The digest of this program: its modules, kernels and data, and what decodes and encodes.

    64 hexadecimal digits. What the files hold is read once for each state of them, as their sizes
    and times tell, and remembered in the cache folder.
    """
    libraries = {**versions(), "numpy": np.__version__}
    parts = [_content(_folders()), json.dumps(libraries, sort_keys=True)]
    return hashlib.sha256("\0".join(parts).encode()).hexdigest()


def _folders() -> list[Path]:
    return [Path(clpipe.__file__).parent, kernel_folder()]


def _content(folders: list[Path]) -> str:
    """The digest of what files hold, by their names in their folders."""
    files = [(folder, path) for folder in folders for path in sorted(_files(folder))]
    stamps = []
    for _, path in files:
        status = path.stat()
        stamps.append([str(path), status.st_size, status.st_mtime_ns])
    cached = cache_folder()
    store, state = Store(cached / "known" if cached else None), json.dumps(stamps)
    if known := store.load("program", state):
        return known.decode("ascii")
    digest = hashlib.sha256()
    for folder, path in files:
        data = path.read_bytes()
        digest.update(f"{path.relative_to(folder).as_posix()}\0{len(data)}\0".encode() + data)
    text = digest.hexdigest()
    store.keep(text.encode("ascii"), "program", state)
    return text


def _files(folder: Path) -> Iterator[Path]:
    """The files below a folder that may decide pixels."""
    for place, folders, names in os.walk(folder):
        at_top = Path(place) == folder
        folders[:] = [
            name
            for name in folders
            if name != "__pycache__" and not (at_top and name in WITHOUT_PIXELS)
        ]
        yield from (Path(place, name) for name in names if not name.endswith(IGNORED))
