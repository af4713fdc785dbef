"""Whole files: their digest, and writing them so that none is ever left half-written."""

import contextlib
import hashlib
import secrets
from collections.abc import Callable
from pathlib import Path

from clpipe.base.errors import ImageError
from clpipe.base.reading import check_regular


def sha256_of(path: Path) -> tuple[str, int]:
    """The SHA-256 of a file, and its size in bytes.

    Raises:
        OSError: it cannot be read, or is no regular file.
    """
    check_regular(path)
    digest = hashlib.sha256()
    with open(path, "rb", buffering=0) as file:
        while part := file.read(4 << 20):
            digest.update(part)
        return digest.hexdigest(), file.tell()


_unfinished: set[Path] = set()  # temporary files of this process, for `remove_temporary_files`


def write_beside(path: Path, write: Callable[[Path], object]) -> None:
    """Write a file under a temporary name beside ``path``, then rename it to ``path``.

    Args:
        path: the file; an existing one is replaced.
        write: writes the whole content to the path that it is called with.

    Raises:
        ImageError: the file cannot be written.
    """
    beside = path.with_name(f".{path.stem}.{secrets.token_hex(4)}.part{path.suffix}")
    _unfinished.add(beside)
    try:
        write(beside)
        beside.replace(path)
    except OSError as error:
        raise ImageError(f"{path}: cannot be written: {error.strerror or error}") from None
    finally:
        with contextlib.suppress(OSError):
            beside.unlink(missing_ok=True)
        _unfinished.discard(beside)


def write_new(path: Path, write: Callable[[Path], object]) -> None:
    """Make the folders above ``path`` where they are missing, then :func:`write_beside`.

    Raises:
        ImageError: the file cannot be written.
    """
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise ImageError(f"{path}: cannot be written: {error.strerror}") from None
    write_beside(path, write)


def remove_temporary_files() -> None:
    """Delete the temporary files that are being written now; call it just before exiting."""
    for path in list(_unfinished):
        with contextlib.suppress(OSError):
            path.unlink(missing_ok=True)
