"""SHA-256 of files, recomputed only if a file has changed."""

import hashlib
import os
from collections.abc import Iterable, Sequence
from contextlib import suppress
from functools import lru_cache
from pathlib import Path
from threading import RLock

from clpipe.base.files import sha256_of
from clpipe.base.urls import stamp_of_url, url_of

_hashing = RLock()


def stamp_of(path: Path) -> tuple[int, int]:
    """Return a file's size in bytes and its modification time in ns; zeros if it is missing.

    A frame of a clip, whose path is below that of the clip, has the clip's. For a path that
    represents a URL, see :func:`clpipe.base.urls.stamp_of_url`.
    """
    try:
        info = path.stat()
    except (OSError, ValueError):  # the file is missing, or the name is invalid
        if os.path.isfile(path.parent):
            return stamp_of(path.parent)
        url = url_of(path)
        return stamp_of_url(url) if url else (0, 0)
    return info.st_size, info.st_mtime_ns


def digests(files: Iterable[str]) -> dict[str, str]:
    """Return the SHA-256 of each file, by name, without files that cannot be read.

    That of a frame of a clip depends on the clip's and on its number.
    """
    by_name = {}
    for file in files:
        with suppress(OSError):
            by_name[file] = _digest(file, *stamp_of(Path(file)))
    return by_name


def joint_digest(digests: Sequence[str]) -> str:
    """Return one SHA-256 for several, computed from their texts; for a single one, itself.

    >>> joint_digest(["ab"]), joint_digest(["ab", "cd"])[:8]
    ('ab', '88d4266f')
    """
    if len(digests) == 1:
        return digests[0]
    return hashlib.sha256("".join(digests).encode()).hexdigest()


@lru_cache(maxsize=1024)
def _digest(file: str, size: int, modified: int) -> str:
    path = Path(file)
    if os.path.isfile(path.parent):
        with _hashing:  # once, if several threads read frames of a large file
            return joint_digest([_digest(str(path.parent), size, modified), path.name])
    return sha256_of(path)[0]
