"""A cache on disk, shared by processes. Its files are validated before they are used.

Each file begins with a digest of its contents and is written atomically. Its name is a digest of
everything that determines its contents. Therefore the cache needs no lock, no entry becomes stale,
and damaged files count as missing.
"""

import hashlib
from contextlib import suppress
from pathlib import Path

from clpipe.base.errors import ImageError
from clpipe.base.files import discard, unsynced_files, write_new

DIGEST = hashlib.sha256().digest_size  # bytes at the beginning of a file


class Store:
    """A cache in a folder.

    Args:
        folder: the folder, which the first write creates. None caches nothing.
        of: texts that are part of every key.
    """

    def __init__(self, folder: Path | None, *namespace: str) -> None:
        self.folder = folder
        self._namespace = namespace

    def path(self, *key: str) -> Path | None:
        """Return the file of a key; None without a folder."""
        parts = b"\0".join(
            hashlib.sha256(part.encode()).digest() for part in (*self._namespace, *key)
        )
        return self.folder / hashlib.sha256(parts).hexdigest()[:40] if self.folder else None

    def load(self, *key: str) -> bytes | None:
        """Return the bytes of a key; None if they are missing or damaged."""
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
        """Store bytes under a key, in place of earlier ones. Errors are ignored."""
        path = self.path(*key)
        if path is not None:
            with suppress(ImageError), unsynced_files():
                write_new(path, hashlib.sha256(data).digest() + data)
