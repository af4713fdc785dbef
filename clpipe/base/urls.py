"""Files behind URLs, through fsspec: ``s3://``, ``https://`` and every other scheme that it knows.

The rest of clpipe handles paths only. A URL is represented by a path in this process's folder for
temporary files, which contains :data:`SPOOL` and then the URL's parts. :func:`path_of` makes that
path, :func:`url_of` reads the URL from it, in any process, and :func:`fetched_files` puts the file
there.

fsspec finds the credentials, in the environment and in its own configuration.
"""

import contextlib
import hashlib
import itertools
import os
import posixpath
import re
import secrets
import threading
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any
from urllib.parse import quote, unquote

from clpipe.base.errors import ClpipeError, ImageError, OutputError, RequestError
from clpipe.base.process_folder import MIN_FREE_SPACE, process_folder
from clpipe.base.transfers import NO_BUCKET, check_scheme, service_code, with_retries
from clpipe.base.url_text import is_glob, is_url, local, name_in

SPOOL = "clpipe-spool"
MAX_NAME = 200  # characters of a folder's name

# Names that file systems use for a file's checksum or modification time, in order of preference.
CHANGE_KEYS = ["ETag", "etag", "md5Hash", "content_md5", "LastModified", "last_modified", "mtime"]
CHANGE_KEYS += ["updated", "modified", "created"]


Stamp = tuple[int, int]

_listed: dict[str, Stamp] = {}  # of files that were listed, by URL
_in_use: set[Path] = set()  # copies of files
_choosing = threading.Lock()  # guards the set


def path_of(text: str) -> Path:
    """Return the path that a text names, or the path that represents it if it is a URL.

    Raises:
        RequestError: fsspec or a package that it needs is missing, it does not know the scheme, no
            path can represent the URL, or there is no folder for temporary files. Or as for
            :func:`~clpipe.base.url_text.local`.
    """
    if not is_url(text):
        return Path(local(text))
    check_scheme(text)
    return _spool_path(text)


def may_be_url(path: Path) -> bool:
    """Return whether a path may represent a URL; much faster than :func:`url_of`."""
    return SPOOL in str(path)


def url_of(path: Path) -> str | None:
    """Return the URL that a path represents; None for a file of this machine.

    >>> url_of(Path("/tmp/x/clpipe-spool/s3/bucket/a/b.exr")), url_of(Path("/tmp/b.exr"))
    ('s3://bucket/a/b.exr', None)
    """
    if not may_be_url(path):
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

    The URL of a file returns itself. The stamps of the files are remembered, see
    :func:`stamp_of_url`.

    Returns:
        The URLs, sorted. There may be none.

    Raises:
        RequestError: the URL cannot be listed.
        TransferError: it cannot be listed now.
    """
    inner = name_in(url)
    scheme, _, rest = inner.partition("://")
    fixed = re.split(r"[*[]", rest)[0].rpartition("/")[0] if is_glob(url) else rest.rstrip("/")
    prefix = f"{scheme}://{fixed}{'/' * bool(fixed)}"

    def work(system: Any, path: str) -> dict[str, Any]:
        root = path.rstrip("/").removesuffix(rest[len(fixed) :].rstrip("/")).rstrip("/")
        system.invalidate_cache()
        found: Mapping[str, Any] = {}
        try:
            find = system.glob if is_glob(url) else system.find
            found = find(path, detail=True)
        except FileNotFoundError as error:
            if NO_BUCKET.search(service_code(error)):
                raise
        # The URL keeps its scheme, because a file system may have several. The file of a URL that
        # is no directory has an empty name.
        return {
            f"{prefix}{name[len(root) :].lstrip('/')}".rstrip("/") + url[len(inner) :]: info
            for name, info in found.items()
            if info.get("type") != "directory"
        }

    for known in list(_listed):  # other threads may change it
        if known.startswith(prefix):
            _listed.pop(known, None)
    infos = with_retries(url, work, RequestError, "listed")
    _listed.update({each: _stamp(info) for each, info in infos.items() if info})
    return sorted(infos)


def listed_stamps(paths: Iterable[Path]) -> dict[str, Stamp]:
    """Return the known stamps of paths that represent URLs, for :func:`remember_stamps`."""
    urls = filter(None, map(url_of, paths))
    return {url: stamp for url in urls if (stamp := _listed.get(url))}


def forget_stamps() -> None:
    """Forget all stamps, so that a new run sees files that have changed."""
    _listed.clear()


def remember_stamps(stamps: Mapping[str, Stamp]) -> None:
    """Remember stamps that another process has listed."""
    _listed.update(stamps)


def stamp_of_url(url: str) -> Stamp:
    """Return a file's size in bytes, and a number that changes with it; zeros if it is missing.

    A file that was listed needs no request.
    """
    if stamp := _listed.get(url):
        return stamp
    with contextlib.suppress(ClpipeError):
        return with_retries(url, lambda system, path: _stamp(system.info(path)), ImageError, "read")
    return 0, 0


@contextlib.contextmanager
def fetched_files(paths: Iterable[Path]) -> Iterator[list[Path]]:
    """Fetch the files of paths that represent URLs, each into a separate folder.

    Yields:
        The paths of the copies, which also represent the URLs. Paths of other files stay the same.

    Raises:
        ImageError: a file cannot be fetched.
    """
    found: list[Path] = []
    copies: list[Path] = []
    try:
        for path in paths:
            found.append(path)
            if (url := url_of(path)) and not path.exists():
                found[-1] = _unused_path(url)
                copies.append(found[-1])
                _fetch(url, found[-1], ImageError)
        yield found
    finally:
        for path in copies:
            path.unlink(missing_ok=True)
            _in_use.discard(path)


def _unused_path(url: str) -> Path:
    """Return a path for a copy of a file that no other copy has, and mark it as in use."""
    with _choosing:
        for number in itertools.count():
            path = _spool_path(url, f"fetched-{number}")
            if path not in _in_use:
                _in_use.add(path)
                return path
    raise AssertionError


def fetch(path: Path) -> Path:
    """Fetch the file of a path that represents a URL. It stays there until this process ends.

    Returns:
        The path.

    Raises:
        RequestError: it cannot be fetched.
        TransferError: it cannot be fetched now.
    """
    if url := url_of(path):
        _fetch(url, path, RequestError)
    return path


def upload(path: Path, url: str) -> None:
    """Write a file to a URL, whole or not at all.

    Raises:
        OutputError: it cannot be written.
    """

    size = path.stat().st_size
    _listed.pop(url, None)

    def work(system: Any, remote: str) -> None:
        system.put_file(str(path), remote)
        system.invalidate_cache(remote)
        if (written := system.info(remote).get("size")) != size:
            raise OSError(f"{written} of {size} bytes were written")

    with_retries(url, work, OutputError, "written", lambda: size)


def read_url(url: str) -> bytes | None:
    """Return the bytes of a small file; None if it is missing.

    Raises:
        OutputError: it cannot be read.
    """

    def work(system: Any, path: str) -> bytes | None:
        with contextlib.suppress(FileNotFoundError):
            return bytes(system.cat_file(path))
        return None

    return with_retries(url, work, OutputError, "read")


def _spool_path(url: str, folder: str = "") -> Path:
    """Return a path that represents a URL, in a folder below this process's folder.

    Raises:
        RequestError: no path can, or there is no folder for temporary files.

    >>> _spool_path("s3://bucket/a/b.exr").relative_to(process_folder()).as_posix()
    'clpipe-spool/s3/bucket/a/b.exr'
    """
    below = process_folder()
    if below is None:
        raise RequestError(
            f"{url}: no folder for temporary files has {MIN_FREE_SPACE >> 20} MiB free and allows "
            "programs to run. Set TMPDIR to such a folder."
        )
    inner = name_in(url)
    scheme, _, rest = inner.partition("://")
    parts = rest.split("/")
    has_drive = os.name == "nt" and ":" in rest
    if {"..", "."} & {*parts} or "" in parts[:-1] or "\\" in url or has_drive:
        raise RequestError(f"{url}: a URL may not contain '..', '.', backslashes or empty parts")
    first = quote(f"{scheme}{url[len(inner) :]}", safe="+")
    if len(first) > MAX_NAME:
        raise RequestError(f"{url}: the URL of an archive may have at most {MAX_NAME} characters")
    return below / folder / SPOOL / first / rest


def _fetch(url: str, path: Path, error_type: type[ClpipeError]) -> None:
    """Copy a file to this machine, whole or not at all, with its stamp as size and time of change.

    Raises:
        ClpipeError: it cannot be fetched. The error has the given type.
    """

    stamp = listed = _listed.get(url)

    def work(system: Any, remote: str) -> Path:
        nonlocal stamp
        if stamp is None:
            try:
                stamp = _stamp(system.info(remote))
            except OSError as error:
                if service_code(error) not in ("400", "403"):  # reading tells the service's reason
                    raise
            if listed and stamp and stamp[0] == listed[0]:  # it was cut off, but has not changed
                stamp = listed
        size, _ = stamp or (0, 0)
        # Other threads may fetch the file, and an abandoned try may still write its part.
        part = path.with_name(f"{path.name}.{secrets.token_hex(4)}.part")
        try:
            system.get_file(remote, str(part))
            if size and (received := part.stat().st_size) != size:
                stamp = None  # the file may have changed since it was listed
                raise OSError(f"{received} of {size} bytes were received")
        except BaseException:
            part.unlink(missing_ok=True)
            raise
        return part

    path.parent.mkdir(parents=True, exist_ok=True)
    part = with_retries(url, work, error_type, "read", lambda: (stamp or (0, 0))[0])
    _, modified = stamp or (0, 0)
    os.utime(part, ns=(modified, modified))
    part.replace(path)


def _stamp(info: Mapping[str, Any]) -> Stamp:
    """Return a file's size in bytes, and a number that changes when the file does."""
    version = next((str(v) for name in CHANGE_KEYS if (v := info.get(name)) is not None), "")
    number = int.from_bytes(hashlib.sha256(version.encode()).digest()[:7]) if version else 0
    return int(info.get("size") or 0), number // 100 * 100  # NTFS stores times in units of 100 ns
