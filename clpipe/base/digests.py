"""SHA-256 of files, computed again only where a file has changed."""

import hashlib
from collections.abc import Iterable, Sequence
from contextlib import suppress
from functools import lru_cache
from pathlib import Path

from clpipe.base.files import sha256_of
from clpipe.base.urls import stamp_of_url, url_of


def stamp_of(path: Path) -> tuple[int, int]:
    """The size of a file in bytes and its time of change in ns; zeros where it has no status.

    Of one that stands for a URL, see :func:`clpipe.base.urls.stamp_of_url`.
    """
    try:
        info = path.stat()
    except (OSError, ValueError):  # or no file can have this name
        url = url_of(path)
        return stamp_of_url(url) if url else (0, 0)
    return info.st_size, info.st_mtime_ns


def digests(files: Iterable[str]) -> dict[str, str]:
    """The SHA-256 of each file, by its name; files that cannot be read are left out."""
    by_name = {}
    for file in files:
        with suppress(OSError):
            by_name[file] = _digest(file, *stamp_of(Path(file)))
    return by_name


def joint_digest(digests: Sequence[str]) -> str:
    """One SHA-256 of several: that of their texts; of one, itself.

    >>> joint_digest(["ab"]), joint_digest(["ab", "cd"])[:8]
    ('ab', '88d4266f')
    """
    if len(digests) == 1:
        return digests[0]
    return hashlib.sha256("".join(digests).encode()).hexdigest()


@lru_cache(maxsize=1024)
def _digest(file: str, size: int, modified: int) -> str:
    return sha256_of(Path(file))[0]
