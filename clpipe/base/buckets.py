"""Files behind URLs, as fsspec knows them: s3://, gs://, az://, http(s):// and others.

Such a file has a place on this machine, to which it is fetched while it is read: a path that has
:data:`SPOOL` in it, and behind that the URL's scheme and what follows. So a path says which URL it
stands for, in any process.

Credentials are fsspec's business alone: those of the environment and of its own configuration.
"""

import contextlib
import hashlib
import os
import posixpath
import random
import re
import secrets
import shutil
import time
from collections.abc import Callable, Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any, TypeVar

from clpipe.base.errors import ImageError, OutputError, RequestError
from clpipe.base.extras import installing
from clpipe.base.text import one_line

T = TypeVar("T")

SPOOL = "clpipe-spool"  # the folder of what stands for URLs

_URL = re.compile(r"([A-Za-z][A-Za-z0-9+.-]+)://(.+)")

TRIES = 6
FIRST_WAIT = 0.25  # s; doubled each time

# Of what fsspec needs beside itself, by the scheme.
PACKAGES = {"s3": "s3fs", "gs": "gcsfs", "gcs": "gcsfs", "az": "adlfs", "abfs": "adlfs"}
PACKAGES |= {"http": "aiohttp", "https": "aiohttp"}

# What file systems say of a file's content or time; what is first counts.
CHANGES = ["ETag", "etag", "md5Hash", "content_md5", "LastModified", "last_modified", "mtime"]
CHANGES += ["updated", "modified", "created"]

# What does not pass: nothing there, no permission, or what a file system cannot do at all.
FINAL = (FileNotFoundError, PermissionError, IsADirectoryError, NotImplementedError)


def is_url(text: str | Path) -> bool:
    """Whether a text is a URL.

    >>> is_url("s3://renders/a.exr"), is_url("C:/renders"), is_url("a.exr")
    (True, False, False)
    """
    return _URL.fullmatch(str(text)) is not None


def place_of(url: str, folder: Path) -> Path:
    """The path that stands for a URL, below a folder for temporary files.

    Raises:
        RequestError: no path can.

    >>> str(place_of("s3://bucket/a/b.exr", Path("/tmp/x")))
    '/tmp/x/clpipe-spool/s3/bucket/a/b.exr'
    """
    found = _URL.fullmatch(url)
    assert found
    parts = found[2].split("/")
    has_drive = os.name == "nt" and ":" in found[2]
    if {"..", "."} & {*parts} or "" in parts[:-1] or "\\" in url or has_drive:
        raise RequestError(f"{url}: expected a URL without '..', '.', backslashes and empty parts")
    return folder / SPOOL / found[1] / found[2]


def url_of(path: Path) -> str | None:
    """The URL that a path stands for; None where it is a file's own.

    >>> url_of(Path("/tmp/x/clpipe-spool/s3/bucket/a/b.exr")), url_of(Path("/tmp/b.exr"))
    ('s3://bucket/a/b.exr', None)
    """
    if SPOOL not in str(path):
        return None
    parts = path.parts
    scheme, *rest = parts[parts.index(SPOOL) + 1 :] if SPOOL in parts else ("",)
    return f"{scheme}://{'/'.join(rest)}" if rest and ".." not in rest else None


def beside(folder: Path, text: str) -> str | None:
    """The URL of a path that counts from a folder which stands for one; None where it is a file's.

    Raises:
        RequestError: it leads out of the bucket.

    >>> beside(Path("/tmp/clpipe-spool/s3/b/lists"), "../r/a.exr"), beside(Path("/tmp"), "a.exr")
    ('s3://b/r/a.exr', None)
    """
    url = url_of(folder)
    if url is None:
        return None
    scheme, _, rest = url.partition("://")
    bucket = rest.split("/")[0]
    joined = posixpath.normpath(posixpath.join(rest, text))
    if joined.split("/")[0] != bucket or text.startswith("/"):
        raise RequestError(f"path: found {text}, which leads out of {scheme}://{bucket}")
    return f"{scheme}://{joined}"


def check_url(url: str) -> None:
    """See that fsspec knows a URL's scheme; nothing is asked of a server.

    Raises:
        RequestError: it does not, or a package is not installed.
    """
    _opened(url)


def is_glob(url: str) -> bool:
    """Whether a URL is a pattern: "?" begins what a server is asked."""
    return any(letter in url for letter in "*[")


def listed(url: str, may_be_missing: bool = False) -> list[str]:
    """The URLs of all files below one, at any depth, or of those that a glob matches, sorted.

    A URL of a file gives itself. The listing stays known, so that stamps cost nothing.

    Args:
        url: the URL.
        may_be_missing: whether there may be nothing; then there are no files.

    Raises:
        RequestError: it cannot be listed.
    """
    system, path = _opened(url)
    above, root = url.rstrip("/"), path.rstrip("/")
    if is_glob(url):  # up to the part that is a pattern
        parts = above.split("/")
        count = len(parts) - next(i for i, part in enumerate(parts) if is_glob(part))
        above, root = "/".join(parts[:-count]), "/".join(root.split("/")[:-count])

    def found() -> Iterable[str]:
        system.invalidate_cache()
        if is_glob(url):
            return [each for each in system.glob(path) if not system.isdir(each)]
        is_file = not url.endswith("/") and system.isfile(path)
        return [path] if is_file else system.find(path)

    try:
        files = _retried(found)
    except FileNotFoundError as error:
        if may_be_missing:
            return []
        raise RequestError(f"{url}: cannot be listed: {_reason(error)}") from None
    except Exception as error:
        raise RequestError(f"{url}: cannot be listed: {_reason(error)}") from None
    # By the scheme that was asked for: a file system may have several.
    return sorted(
        url if each == path else f"{above}/{each[len(root) :].lstrip('/')}" for each in files
    )


def stamp_of_url(url: str) -> tuple[int, int]:
    """The size of a file, and a number that changes with it; zeros where it is not there."""
    with contextlib.suppress(Exception):
        system, path = _opened(url)
        return _stamp(_retried(lambda: system.info(path)))
    return 0, 0


@contextlib.contextmanager
def fetched(paths: Iterable[Path]) -> Iterator[list[Path]]:
    """Where files that stand for URLs are meanwhile, each by itself; others are where they were.

    Raises:
        ImageError: one cannot be fetched.
    """
    made: list[Path] = []
    found: list[Path] = []
    try:
        for path in paths:
            url = url_of(path)
            if url is None or path.exists():
                found.append(path)
                continue
            root = Path(*path.parts[: path.parts.index(SPOOL)])
            made.append(root / f"fetched-{secrets.token_hex(8)}")  # others may read it, too
            found.append(place_of(url, made[-1]))
            _fetch(url, found[-1])
        yield found
    finally:
        for folder in made:
            shutil.rmtree(folder, ignore_errors=True)


def fetch(path: Path) -> None:
    """Fetch a file that stands for a URL, where it does, and leave it there.

    Raises:
        RequestError: it cannot be fetched.
    """
    try:
        if url := url_of(path):
            _fetch(url, path)
    except ImageError as error:
        raise RequestError(str(error)) from None


def _fetch(url: str, path: Path) -> None:
    part = path.with_name(f"{path.name}.{secrets.token_hex(4)}.part")  # processes may share it

    def work() -> None:
        system, remote = _opened(url)
        info = system.info(remote)
        size, modified = _stamp(info)
        system.get_file(remote, str(part))
        if info.get("size") is not None and part.stat().st_size != size:
            raise OSError(f"{part.stat().st_size} of {size} bytes came")
        os.utime(part, ns=(modified, modified))

    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        _retried(work)
        part.replace(path)
    except Exception as error:
        part.unlink(missing_ok=True)
        raise ImageError(f"{url}: cannot be read: {_reason(error)}") from None


def upload(path: Path, url: str) -> None:
    """Put a file behind a URL, whole or not at all.

    Raises:
        OutputError: it cannot be put there.
    """

    def work() -> None:
        system, remote = _opened(url)
        system.put_file(str(path), remote)
        system.invalidate_cache()
        if (size := system.info(remote).get("size")) != path.stat().st_size:
            raise OSError(f"{size} of {path.stat().st_size} bytes are there")

    try:
        _retried(work)
    except Exception as error:
        raise OutputError(f"{url}: cannot be written: {_reason(error)}") from None


def read_url(url: str) -> bytes | None:
    """The bytes of a small file; None where it is not there.

    Raises:
        OutputError: it cannot be read.
    """
    system, path = _opened(url)
    try:
        data = _retried(lambda: system.cat_file(path))
    except FileNotFoundError:
        return None
    except Exception as error:
        raise OutputError(f"{url}: cannot be read: {_reason(error)}") from None
    return bytes(data)


def _opened(url: str) -> tuple[Any, str]:
    """The file system of a URL, and the path in it.

    Raises:
        RequestError: fsspec, or what it needs for the scheme, is not installed, or unknown.
    """
    try:
        from fsspec.core import url_to_fs
    except ImportError:
        raise RequestError(f"{url}: needs fsspec; {installing('fsspec')}") from None
    scheme = url.partition("://")[0]
    try:
        system, path = url_to_fs(url)
    except ImportError as error:
        package = PACKAGES.get(scheme)
        needs = f"needs {package}; {installing(package)}" if package else _reason(error)
        raise RequestError(f"{url}: {needs}") from None
    except ValueError as error:
        raise RequestError(f"{url}: {_reason(error)}") from None
    return system, path


def _stamp(info: Mapping[str, Any]) -> tuple[int, int]:
    """Size, and a number of what says that a file changed: ETag, checksum or time."""
    said = next((str(v) for name in CHANGES if (v := info.get(name)) is not None), "")
    number = int.from_bytes(hashlib.sha256(said.encode()).digest()[:7]) if said else 0
    return int(info.get("size") or 0), number // 100 * 100  # as a file's time, of which NTFS keeps


def _retried(work: Callable[[], T]) -> T:
    """What some work gives, tried again after what may pass.

    Raises:
        Exception: what the last try raises, or one that does not pass.
    """
    wait = FIRST_WAIT
    for left in reversed(range(TRIES)):
        try:
            return work()
        except FINAL:
            raise
        except Exception as error:
            if not left or isinstance(error, RequestError):
                raise
            time.sleep(wait * random.uniform(0.5, 1.0))  # noqa: S311 - no secret
            wait *= 2
    raise AssertionError


def _reason(error: BaseException) -> str:
    """An error in one line."""
    return one_line(str(error) or type(error).__name__)
