"""Files behind URLs, through fsspec: ``s3://``, ``https://`` and every other scheme that it knows.

The rest of clpipe handles paths only. A URL is represented by a path in this process's folder for
temporary files, which contains :data:`SPOOL` and then the URL's parts. :func:`path_of` makes that
path, :func:`url_of` reads the URL from it, in any process, and :func:`fetched_files` puts the file
there.

fsspec finds the credentials, in the environment and in its own configuration.
"""

import contextlib
import hashlib
import os
import posixpath
import random
import re
import secrets
import tempfile
import time
from collections.abc import Callable, Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any, TypeVar
from urllib.parse import quote, unquote

from clpipe.base.errors import ClpipeError, ImageError, OutputError, RequestError
from clpipe.base.extras import require
from clpipe.base.process_folder import MIN_FREE_SPACE, process_folder
from clpipe.base.text import one_line
from clpipe.base.url_text import is_glob, is_url, local, name_in

T = TypeVar("T")

SPOOL = "clpipe-spool"
MAX_NAME = 200  # characters of a folder's name

# The packages of the extra "cloud" that file systems need, by scheme.
PACKAGES = {
    **dict.fromkeys(("s3", "s3a"), "s3fs"),
    **dict.fromkeys(("gs", "gcs"), "gcsfs"),
    **dict.fromkeys(("az", "abfs", "abfss", "adl"), "adlfs"),
    **dict.fromkeys(("http", "https"), "aiohttp"),
}

MAX_TRIES = 6
FIRST_WAIT = 0.25  # s; each further wait is twice as long

# Names that file systems use for a file's checksum or modification time, in order of preference.
CHANGE_KEYS = ["ETag", "etag", "md5Hash", "content_md5", "LastModified", "last_modified", "mtime"]
CHANGE_KEYS += ["updated", "modified", "created"]

# Errors that are not retried.
PERMANENT_ERRORS = (
    FileNotFoundError,
    PermissionError,
    IsADirectoryError,
    NotImplementedError,
    KeyError,  # of an archive without that file
)


def path_of(text: str) -> Path:
    """Return the path that a text names, or the path that represents it if it is a URL.

    Raises:
        RequestError: fsspec or a package that it needs is missing, it does not know the scheme, no
            path can represent the URL, or there is no folder for temporary files. Or as for
            :func:`~clpipe.base.url_text.local`.
    """
    if not is_url(text):
        return Path(local(text))
    _check_scheme(text)
    folder = process_folder()
    if folder is None:
        raise RequestError(
            f"{text}: no folder for temporary files has {MIN_FREE_SPACE >> 20} MiB free and allows "
            "programs to run. Set TMPDIR to such a folder."
        )
    return _spool_path(text, folder)


def url_of(path: Path) -> str | None:
    """Return the URL that a path represents; None for a file of this machine.

    >>> url_of(Path("/tmp/x/clpipe-spool/s3/bucket/a/b.exr")), url_of(Path("/tmp/b.exr"))
    ('s3://bucket/a/b.exr', None)
    """
    if SPOOL not in str(path):
        return None
    parts = path.parts
    first, *rest = parts[parts.index(SPOOL) + 1 :] if SPOOL in parts else ("",)
    scheme, _, archive = unquote(first).partition("::")
    container = f"::{archive}" if archive else ""
    return f"{scheme}://{'/'.join(rest)}{container}" if rest and ".." not in rest else None


def join_url(folder: Path, text: str) -> Path:
    """Return the path that a text names: a URL, or a path relative to a folder.

    Raises:
        RequestError: the folder represents a URL, and the path leads out of its bucket; or as for
            :func:`path_of`.
    """
    text, url = local(text), url_of(folder)
    if is_url(text) or url is None:
        return path_of(text) if is_url(text) else folder / text
    scheme, _, rest = url.partition("://")
    bucket = rest.split("/")[0]
    inside = posixpath.normpath(posixpath.join(rest, text))
    if inside.split("/")[0] != bucket:
        raise RequestError(f"path: {text} leads out of {scheme}://{bucket}. Use a path inside it.")
    return path_of(f"{scheme}://{inside}")


def list_urls(url: str) -> list[str]:
    """Return the URLs of all files below one, at any depth, or of those that a glob matches.

    The URL of a file returns itself. fsspec remembers the listing, so that stamps cost nothing.

    Returns:
        The URLs, sorted. There may be none.

    Raises:
        RequestError: the URL cannot be listed.
    """
    inner = name_in(url)
    scheme, _, rest = inner.partition("://")
    fixed = re.split(r"[*[]", rest)[0].rpartition("/")[0] if is_glob(url) else rest.rstrip("/")
    prefix = f"{scheme}://{fixed}{'/' * bool(fixed)}"

    def work(system: Any, path: str) -> list[str]:
        root = path.rstrip("/").removesuffix(rest[len(fixed) :].rstrip("/")).rstrip("/")
        _forget_listing(system, root)
        found: Iterable[str] = ()
        with contextlib.suppress(FileNotFoundError):
            if is_glob(url):
                infos = system.glob(path, detail=True)
                found = [name for name, info in infos.items() if info["type"] != "directory"]
            else:
                found = system.find(path)
        # The URL keeps its scheme, because a file system may have several.
        names = (name[len(root) :].lstrip("/") for name in found)
        # The file of a URL that is no directory has an empty name.
        return sorted(f"{prefix}{name}".rstrip("/") + url[len(inner) :] for name in names)

    return _with_retries(url, work, RequestError, "listed")


def _forget_listing(system: Any, folder: str) -> None:
    """Make a file system list a folder and all folders in it again. It keeps other listings.

    A run lists its inputs before its output, and the listing of inputs has all their stamps.
    """
    if not folder:
        system.invalidate_cache()
        return
    system.invalidate_cache(folder)
    for name in [each for each in system.dircache if each.startswith(f"{folder}/")]:
        system.dircache.pop(name, None)


def stamp_of_url(url: str) -> tuple[int, int]:
    """Return a file's size in bytes, and a number that changes with it; zeros if it is missing."""
    with contextlib.suppress(ClpipeError):
        return _with_retries(
            url, lambda system, path: _stamp(system.info(path)), ImageError, "read"
        )
    return 0, 0


@contextlib.contextmanager
def fetched_files(paths: Iterable[Path]) -> Iterator[list[Path]]:
    """Fetch the files of paths that represent URLs, each into a separate folder.

    Yields:
        The paths of the copies, which also represent the URLs. Paths of other files stay the same.

    Raises:
        ImageError: a file cannot be fetched.
    """
    with contextlib.ExitStack() as stack:
        found: list[Path] = []
        for path in paths:
            found.append(path)
            if (url := url_of(path)) and not path.exists():
                folder = tempfile.TemporaryDirectory(
                    prefix="fetched-", dir=process_folder(), ignore_cleanup_errors=True
                )
                found[-1] = _spool_path(url, Path(stack.enter_context(folder)))
                _fetch(url, found[-1], ImageError)
        yield found


def fetch(path: Path) -> Path:
    """Fetch the file of a path that represents a URL. It stays there until this process ends.

    Returns:
        The path.

    Raises:
        RequestError: it cannot be fetched.
    """
    if url := url_of(path):
        _fetch(url, path, RequestError)
    return path


def upload(path: Path, url: str) -> None:
    """Write a file to a URL, whole or not at all.

    Raises:
        OutputError: it cannot be written.
    """

    def work(system: Any, remote: str) -> None:
        system.put_file(str(path), remote)
        system.invalidate_cache(remote)
        if (size := system.info(remote).get("size")) != path.stat().st_size:
            raise OSError(f"only {size} of {path.stat().st_size} bytes were written")

    _with_retries(url, work, OutputError, "written")


def read_url(url: str) -> bytes | None:
    """Return the bytes of a small file; None if it is missing.

    Raises:
        OutputError: it cannot be read.
    """

    def work(system: Any, path: str) -> bytes | None:
        with contextlib.suppress(FileNotFoundError):
            return bytes(system.cat_file(path))
        return None

    return _with_retries(url, work, OutputError, "read")


def _check_scheme(url: str) -> None:
    """Check that fsspec knows a URL's scheme, without contacting a server.

    Raises:
        RequestError: the scheme is unknown, or a package is missing. The message names the package.
    """
    schemes = [part.partition("://")[0] for part in url.split("::") if "://" in part]
    packages = [PACKAGES[scheme] for scheme in schemes if scheme in PACKAGES]
    require(url, "cloud", "fsspec", *packages)
    if "://" not in name_in(url):
        raise RequestError(
            f"{url}: clpipe fetches each file once, so it needs no cache; use "
            f"{url.partition('::')[2]}"
        )
    from fsspec import get_filesystem_class

    try:
        for scheme in schemes:
            get_filesystem_class(scheme)
    except (ImportError, ValueError) as error:
        raise RequestError(f"{url}: {one_line(str(error))}") from None


def _spool_path(url: str, folder: Path) -> Path:
    """Return the path that represents a URL, below a folder for temporary files.

    Raises:
        RequestError: no path can.

    >>> str(_spool_path("s3://bucket/a/b.exr", Path("/tmp/x")))
    '/tmp/x/clpipe-spool/s3/bucket/a/b.exr'
    """
    inner = name_in(url)
    scheme, _, rest = inner.partition("://")
    parts = rest.split("/")
    has_drive = os.name == "nt" and ":" in rest
    if {"..", "."} & {*parts} or "" in parts[:-1] or "\\" in url or has_drive:
        raise RequestError(f"{url}: a URL may not contain '..', '.', backslashes or empty parts")
    first = quote(f"{scheme}{url[len(inner) :]}", safe="+")
    if len(first) > MAX_NAME:
        raise RequestError(f"{url}: the URL of an archive may have at most {MAX_NAME} characters")
    return folder / SPOOL / first / rest


def _fetch(url: str, path: Path, error_type: type[ClpipeError]) -> None:
    """Copy a file to this machine, whole or not at all, with its stamp as size and time of change.

    Raises:
        ClpipeError: it cannot be fetched. The error has the given type.
    """
    part = path.with_name(f"{path.name}.{secrets.token_hex(4)}.part")  # other threads may fetch it

    def work(system: Any, remote: str) -> None:
        path.parent.mkdir(parents=True, exist_ok=True)
        info = system.info(remote)
        size, modified = _stamp(info)
        system.get_file(remote, str(part))
        if info.get("size") is not None and part.stat().st_size != size:
            raise OSError(f"only {part.stat().st_size} of {size} bytes were received")
        os.utime(part, ns=(modified, modified))
        part.replace(path)

    try:
        _with_retries(url, work, error_type, "read")
    finally:
        part.unlink(missing_ok=True)


def _stamp(info: Mapping[str, Any]) -> tuple[int, int]:
    """Return a file's size in bytes, and a number that changes when the file does."""
    version = next((str(v) for name in CHANGE_KEYS if (v := info.get(name)) is not None), "")
    number = int.from_bytes(hashlib.sha256(version.encode()).digest()[:7]) if version else 0
    return int(info.get("size") or 0), number // 100 * 100  # NTFS stores times in units of 100 ns


def _reason(url: str, error: Exception) -> str:
    """Return the text of an error; if it only repeats a part of the URL, what the error means."""
    text = one_line(str(error))
    if text.strip("'/") not in url:
        return text
    if isinstance(error, FileNotFoundError | KeyError):
        return "there is no such file"
    return "access is denied" if isinstance(error, PermissionError) else type(error).__name__


def _with_retries(
    url: str, work: Callable[[Any, str], T], error_type: type[ClpipeError], what: str
) -> T:
    """Return the result of a function for a URL's file system and the path in it.

    The function is retried after errors that may be temporary.

    Raises:
        RequestError: as for :func:`_check_scheme`.
        ClpipeError: all tries failed. The error has the type ``error_type``.
    """
    _check_scheme(url)
    from fsspec.core import url_to_fs

    wait = FIRST_WAIT
    for tries_left in reversed(range(MAX_TRIES)):
        try:
            return work(*url_to_fs(url))
        except Exception as error:
            if not tries_left or isinstance(error, PERMANENT_ERRORS):
                raise error_type(f"{url}: cannot be {what}: {_reason(url, error)}") from None
            time.sleep(wait * random.uniform(0.5, 1.0))  # noqa: S311 - no secret
            wait *= 2
    raise AssertionError
