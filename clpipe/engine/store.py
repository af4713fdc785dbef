"""A cache on disk, shared by processes. Its files are validated before they are used.

Each file begins with a digest of its contents and is written atomically. The names of the file and
of its folder are digests of everything that determines its contents. Therefore the cache needs no
lock, no entry becomes stale, and damaged files count as missing.
"""

import hashlib
import os
from contextlib import suppress
from pathlib import Path

from clpipe.base.errors import ImageError
from clpipe.base.files import discard, unsynced_files, write_new

DIGEST = hashlib.sha256().digest_size  # bytes at the beginning of a file


def digest_of(texts: tuple[str, ...]) -> str:
    """Return the digest of several texts, as 40 hexadecimal digits."""
    parts = b"\0".join(hashlib.sha256(text.encode()).digest() for text in texts)
    return hashlib.sha256(parts).hexdigest()[:40]


class Store:
    """A cache in a folder, with a subfolder for each namespace.

    Args:
        folder: the folder, which the first write creates. None caches nothing.
        *namespace: texts that are part of every key.
    """

    def __init__(self, folder: Path | None, *namespace: str) -> None:
        self.folder = folder / digest_of(namespace) if folder and namespace else folder

    def __len__(self) -> int:
        """The number of entries in this namespace. Damaged entries count."""
        try:
            return len(os.listdir(self.folder)) if self.folder else 0
        except OSError:
            return 0

    def path(self, *key: str) -> Path | None:
        """Return the file of a key; None without a folder."""
        return self.folder / digest_of(key) if self.folder else None

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

    def keep(self, data: bytes, *key: str) -> bool:
        """Store bytes under a key, in place of earlier ones, and return whether that succeeded."""
        path = self.path(*key)
        if path is not None:
            with suppress(ImageError), unsynced_files():
                write_new(path, hashlib.sha256(data).digest() + data)
                return True
        return False
