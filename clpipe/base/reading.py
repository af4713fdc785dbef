"""Other people's files: regular ones only, no larger than they can be, and their text as values.

Reading a device or a pipe may never end, and a small file may ask for more memory than there is.
Errors of files are an OSError with a clear ``strerror``, errors of their content a ValueError.
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
from clpipe.base.memory import in_words
from clpipe.base.text import alike

T = TypeVar("T")

TEXT_BYTES = 16 * 2**20  # the largest text but a manifest: a configuration, a curve, a sidecar

KEY_PARTS = 32  # of a dotted key; tomllib takes memory with their square

SEARCHED = 20_000  # names in a folder, among which a similar one is looked for

KINDS = {
    stat.S_IFDIR: "a folder",
    stat.S_IFCHR: "a device",
    stat.S_IFBLK: "a device",
    stat.S_IFIFO: "a named pipe",
    stat.S_IFSOCK: "a socket",
}

_PART = r"""(?:[\w-]++|"(?:\\.|[^"\\\n])*+"|'[^'\n]*+')[ \t]*+\.[ \t]*+"""
_LONG_KEY = re.compile(rf"(?<![\w-])(?:{_PART}){{{KEY_PARTS}}}", re.ASCII)


def check_regular(path: Path) -> os.stat_result:
    """The status of a regular file, or of one that a link leads to; nothing is opened.

    Raises:
        OSError: it is missing, or a folder, a device, a pipe or a socket.
    """
    try:
        status = path.stat()
    except ValueError:  # a NUL, or characters that are not UTF-8
        raise OSError(errno.EINVAL, "no file can have this name") from None
    kind = stat.S_IFMT(status.st_mode)
    if kind != stat.S_IFREG:
        raise OSError(errno.EINVAL, f"it is {KINDS.get(kind, 'something else')}, not a file")
    return status


def read_when_changed(read: Callable[[str], T]) -> Callable[[str], T]:
    """A function of a file's path that keeps what it reads, and reads again when it changes.

    It raises an OSError where the path is no regular file.
    """

    @lru_cache(maxsize=16)
    def kept(path: str, time: int, size: int) -> T:
        return read(path)

    @wraps(read)
    def current(path: str) -> T:
        status = check_regular(Path(path))
        return kept(path, status.st_mtime_ns, status.st_size)

    return current


def check_exists(path: Path) -> None:
    """See that a file or folder exists that was named.

    Raises:
        MissingError: it does not; the message suggests a name that is similar and exists.
    """
    try:
        os.stat(path)
        return
    except (FileNotFoundError, NotADirectoryError):
        pass
    except (OSError, ValueError):  # reading it tells why
        return
    os.getcwd()  # where that has gone, it is what is wrong
    place, rest = path, Path()
    while not os.path.exists(place.parent) and place != place.parent:
        place, rest = place.parent, place.name / rest
    near = _similar(place)
    hint = f"; did you mean {near / rest}?" if near else ""
    raise MissingError(str(path), f"{path}: there is no such file or folder{hint}")


def check_input(path: Path) -> None:
    """See that a file or folder that was named as an input exists and is no array of NumPy.

    Raises:
        MissingError: it does not exist.
        RequestError: it is an array, which clpipe writes and does not read.
    """
    check_exists(path)
    if path.suffix.lower() == ".npy":
        raise RequestError(
            f"{path}: it is an array of NumPy, as --format npy writes it, which clpipe does not "
            "read. Load it with numpy.load, or write a file that clpipe reads with --format exr"
        )


def _similar(path: Path) -> Path | None:
    """What is called like a missing file, in its folder; one with its suffix comes first."""
    try:
        with os.scandir(path.parent) as entries:
            names = [entry.name for entry in islice(entries, SEARCHED)]
    except OSError:
        return None
    by_stem: dict[str, str] = {}
    for name in sorted(names, key=lambda name: (Path(name).suffix != path.suffix, name)):
        by_stem.setdefault(Path(name).stem, name)
    near = alike(path.stem, by_stem, cutoff=0.7)
    return path.with_name(by_stem[near[0]]) if near else None


@contextmanager
def unchanged(path: Path) -> Iterator[None]:
    """See that a file stays the same while it is read, so that its digest is that of its pixels.

    Raises:
        ImageError: it was written to, replaced or removed.
    """
    before = _state(path)
    yield
    if _state(path) != before:
        raise ImageError(f"{path}: was written to while it was read; run it again")


def _state(path: Path) -> tuple[int, ...]:
    try:
        status = path.stat()
    except (OSError, ValueError):
        return ()
    return status.st_ino, status.st_size, status.st_mtime_ns


def read_bytes(path: Path, most: int = TEXT_BYTES) -> bytes:
    """The content of a regular file of at most ``most`` bytes.

    Raises:
        OSError: it cannot be read, is no regular file, or is larger.
    """
    size = check_regular(path).st_size
    with path.open("rb") as file:
        data = b"" if size > most else file.read(size + 1)
        if len(data) > size:  # it has grown
            data += file.read(most + 1 - len(data))
    if max(size, len(data)) > most:
        found = in_words(max(size, len(data)))
        raise OSError(errno.EFBIG, f"it has {found}; at most {in_words(most)} are read")
    return data


def read_named(option: str, path: Path, most: int) -> bytes:
    """The content of a file that an option names, of at most ``most`` bytes.

    Raises:
        RequestError: as :func:`read_bytes`.
    """
    try:
        return read_bytes(path, most)
    except OSError as error:
        raise RequestError(f"{option} {path}: cannot be read: {error.strerror}") from None


def read_text(path: Path) -> str:
    """The text of a small file in UTF-8, with or without a byte order mark.

    Raises:
        OSError: as :func:`read_bytes`.
        UnicodeDecodeError: it is not UTF-8.
    """
    return read_bytes(path).decode("utf-8-sig")


def parse_toml(text: str) -> dict[str, Any]:
    """The values of a TOML text.

    Raises:
        ValueError: it is not valid, or is nested too deeply to be read.
    """
    if _LONG_KEY.search(text):
        raise ValueError(f"a key has more than {KEY_PARTS} parts")
    try:
        return tomllib.loads(text)
    except RecursionError:
        raise ValueError("it is nested too deeply") from None


def parse_json(text: str | bytes) -> Any:
    """The value of a JSON text.

    Raises:
        ValueError: it is not valid, is nested too deeply to be read, or holds half a character.
    """
    text = text.decode("utf-8-sig") if isinstance(text, bytes) else text
    try:
        value = json.loads(text)
        if "\\ud" in text.lower():  # perhaps half a character, which can name no file
            os.fsencode(json.dumps(value, ensure_ascii=False))
        return value
    except RecursionError:
        raise ValueError("it is nested too deeply") from None
