"""A store of what is kept between processes, as files that are looked at before they are believed.

Each file begins with its digest, is written whole or not at all, and is named after all that
decides what is in it. So there is no lock, nothing goes stale, and what is damaged is not there.
"""

import hashlib
from contextlib import suppress
from pathlib import Path

from clpipe.base.errors import ImageError
from clpipe.base.files import discard, passing_files, write_new

DIGEST = hashlib.sha256().digest_size  # bytes at the beginning of a file


class Store:
    """A folder of kept things.

    Args:
        folder: for the files, made when the first one is written; None keeps nothing.
        of: what decides all of them; the parts of a key decide each.
    """

    def __init__(self, folder: Path | None, *of: str) -> None:
        self.folder = folder
        self._of = of

    def path(self, *key: str) -> Path | None:
        """The file of a key; None without a folder."""
        parts = b"\0".join(hashlib.sha256(part.encode()).digest() for part in (*self._of, *key))
        return self.folder / hashlib.sha256(parts).hexdigest()[:40] if self.folder else None

    def load(self, *key: str) -> bytes | None:
        """The bytes that are kept under a key; None where it is not there, or damaged."""
        path = self.path(*key)
        if path is None:
            return None
        try:
            data = path.read_bytes()
        except FileNotFoundError:
            return None
        except OSError:
            data = b""
        if hashlib.sha256(data[DIGEST:]).digest() == data[:DIGEST]:
            return data[DIGEST:]
        discard(path)
        return None

    def keep(self, data: bytes, *key: str) -> None:
        """Keep something, if there is room, in place of what was there."""
        path = self.path(*key)
        if path is not None:
            with suppress(ImageError), passing_files():
                write_new(path, hashlib.sha256(data).digest() + data)
