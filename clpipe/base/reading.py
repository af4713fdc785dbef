"""Safe reading of untrusted files: only regular files, limited in size; and parsing of their text.

Reading a device or a pipe may never end, and a small file may need more memory than there is. File
errors are an OSError with a clear ``strerror``. Errors in the contents are a ValueError.
"""

import errno
import json
import os
import re
import stat
import tomllib
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import lru_cache, wraps
from itertools import islice
from pathlib import Path
from typing import Any, TypeVar

from clpipe.base.errors import ImageError, MissingError, RequestError
from clpipe.base.memory import format_bytes
from clpipe.base.text import similar_names

T = TypeVar("T")

# Bytes; the largest configuration, curve or sidecar (manifests may be larger).
TEXT_BYTES = 16 * 2**20

KEY_PARTS = 32  # parts of a dotted key; limited because tomllib's memory grows with their square

MAX_SEARCHED = 20_000  # files of a folder that are searched for a similar name

FILE_TYPES = {
    stat.S_IFDIR: "a folder",
    stat.S_IFCHR: "a device",
    stat.S_IFBLK: "a device",
    stat.S_IFIFO: "a named pipe",
    stat.S_IFSOCK: "a socket",
}

_PART = r"""(?:[\w-]++|"(?:\\.|[^"\\\n])*+"|'[^'\n]*+')[ \t]*+\.[ \t]*+"""
_LONG_KEY = re.compile(rf"(?<![\w-])(?:{_PART}){{{KEY_PARTS}}}", re.ASCII)


def check_regular(path: Path) -> os.stat_result:
    """Return the status of a regular file, following links, without opening it.

    Raises:
        OSError: the file is missing, or is a folder, a device, a pipe or a socket.
    """
    try:
        status = path.stat()
    except ValueError:  # a NUL, or characters that are not UTF-8
        raise OSError(errno.EINVAL, "no file can have this name") from None
    kind = stat.S_IFMT(status.st_mode)
    if kind != stat.S_IFREG:
        raise OSError(errno.EINVAL, f"it is {FILE_TYPES.get(kind, 'something else')}, not a file")
    return status


def cached_by_mtime(read: Callable[[str], T]) -> Callable[[str], T]:
    """Decorate a function that reads a file, so that it reads again only if the file has changed.

    The function raises an OSError if the path is not a regular file.
    """

    @lru_cache(maxsize=16)
    def cached(path: str, time: int, size: int) -> T:
        return read(path)

    @wraps(read)
    def current(path: str) -> T:
        status = check_regular(Path(path))
        return cached(path, status.st_mtime_ns, status.st_size)

    return current


def check_exists(path: Path) -> None:
    """Check that a named file or folder exists.

    Raises:
        MissingError: it does not exist. The message suggests a similar existing name.
        RequestError: no file can have this name.
    """
    try:
        os.stat(path)
        return
    except (FileNotFoundError, NotADirectoryError):
        pass
    except ValueError:  # a NUL, or characters that are not UTF-8
        raise RequestError(f"{str(path)!r}: no file can have this name; correct it") from None
    except OSError:  # reading the file later reports the reason
        return
    os.getcwd()  # raises if the working directory is missing, which is then the actual error
    place, rest = path, Path()
    while not os.path.exists(place.parent) and place != place.parent:
        place, rest = place.parent, place.name / rest
    similar = _similar(place)
    hint = f". Did you mean {similar / rest}?" if similar else ""
    raise MissingError(str(path), f"{path}: there is no such file or folder{hint}")


def check_input(path: Path) -> None:
    """Check that a named input exists and is not a NumPy array.

    Raises:
        MissingError: it does not exist.
        RequestError: it is a NumPy array, which clpipe writes but does not read.
    """
    check_exists(path)
    if path.suffix.lower() == ".npy":
        raise RequestError(
            f"{path}: this is a NumPy array, which clpipe writes (--format npy) but does not read. "
            "Load it with numpy.load. For a file that clpipe reads, use --format exr."
        )


def _similar(path: Path) -> Path | None:
    """Return a file with a similar name in a missing file's folder, preferably of its extension."""
    try:
        with os.scandir(path.parent) as entries:
            names = [entry.name for entry in islice(entries, MAX_SEARCHED)]
    except OSError:
        return None
    by_stem: dict[str, str] = {}
    for name in sorted(names, key=lambda name: (Path(name).suffix != path.suffix, name)):
        by_stem.setdefault(Path(name).stem, name)
    similar = similar_names(path.stem, by_stem, cutoff=0.7)
    return path.with_name(by_stem[similar[0]]) if similar else None


@contextmanager
def check_unchanged(path: Path) -> Iterator[None]:
    """Check that a file does not change in the ``with`` block, so that its digest fits its pixels.

    Raises:
        ImageError: the file was changed, replaced or removed.
    """
    before = _state(path)
    yield
    if _state(path) != before:
        raise ImageError(f"{path}: the file changed while it was read. Run the command again.")


def _state(path: Path) -> tuple[int, ...]:
    try:
        status = path.stat()
    except (OSError, ValueError):
        return ()
    return status.st_ino, status.st_size, status.st_mtime_ns


@contextmanager
def read_errors(name: object, error_type: type[Exception] = ImageError) -> Iterator[None]:
    """Name the file in an OSError of the ``with`` block, and raise it as an error of a type."""
    try:
        yield
    except OSError as error:
        raise error_type(f"{name}: cannot be read: {error.strerror or error}") from None


def read_start(path: Path, count: int) -> bytes:
    """Return the first bytes of a regular file.

    Raises:
        OSError: the file cannot be read, or is not a regular file.
    """
    check_regular(path)
    with path.open("rb") as file:
        return file.read(count)


def read_bytes(path: Path, max_bytes: int = TEXT_BYTES) -> bytes:
    """Return the contents of a regular file of at most ``max_bytes`` bytes.

    Raises:
        OSError: the file cannot be read, is not a regular file, or is larger.
    """
    size = check_regular(path).st_size
    with path.open("rb") as file:
        data = b"" if size > max_bytes else file.read(size + 1)
        if len(data) > size:  # the file has grown
            data += file.read(max_bytes + 1 - len(data))
    if max(size, len(data)) > max_bytes:
        found = format_bytes(max(size, len(data)))
        raise OSError(errno.EFBIG, f"it has {found}, but the limit is {format_bytes(max_bytes)}")
    return data


def read_named(option: str, path: Path, max_bytes: int) -> bytes:
    """Return the contents of a file that an option names, of at most ``max_bytes`` bytes.

    Raises:
        RequestError: the file cannot be read, is not a regular file, or is larger.
    """
    with read_errors(f"{option} {path}", RequestError):
        return read_bytes(path, max_bytes)


def read_named_text(name: str, path: Path, max_bytes: int = TEXT_BYTES) -> str:
    """Return the text of a UTF-8 file, with or without a byte order mark.

    Raises:
        RequestError: it is no such file, or is larger than ``max_bytes``. The message begins with
            ``name``.
    """
    with read_errors(name, RequestError):
        data = read_bytes(path, max_bytes)
    try:
        return data.decode("utf-8-sig")
    except UnicodeDecodeError:
        raise RequestError(f"{name}: this file is not text in UTF-8") from None


def read_text(path: Path) -> str:
    """Return the text of a small UTF-8 file, with or without a byte order mark.

    Raises:
        OSError: as for :func:`read_bytes`.
        UnicodeDecodeError: the file is not UTF-8.
    """
    return read_bytes(path).decode("utf-8-sig")


def parse_toml(text: str) -> dict[str, Any]:
    """Return the values of a TOML text.

    Raises:
        ValueError: the text is not valid TOML, or is nested too deeply.
    """
    if _LONG_KEY.search(text):
        raise ValueError(f"a key has more than {KEY_PARTS} parts")
    try:
        return tomllib.loads(text)
    except RecursionError:
        raise ValueError("it is nested too deeply") from None


def parse_json(text: str | bytes) -> Any:
    """Return the value of a JSON text.

    Raises:
        ValueError: the text is not valid JSON, is nested too deeply, or has an unpaired surrogate.
    """
    text = text.decode("utf-8-sig") if isinstance(text, bytes) else text
    try:
        value = json.loads(text)
        if "\\ud" in text.lower():  # perhaps an unpaired surrogate, invalid in file names
            os.fsencode(json.dumps(value, ensure_ascii=False))
        return value
    except RecursionError:
        raise ValueError("it is nested too deeply") from None
