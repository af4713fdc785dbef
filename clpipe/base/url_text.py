"""The meaning of a text that may be a path or a URL, without contacting a server."""

import os
import re
from pathlib import Path
from urllib.parse import unquote

from clpipe.base.errors import RequestError
from clpipe.base.text import one_line

# A file in an archive is a chain of URLs, such as zip://a.exr::https://host/b.zip.
_URL = re.compile(r"(?:[A-Za-z][A-Za-z0-9+.-]+::)*[A-Za-z][A-Za-z0-9+.-]+://.+", re.DOTALL)
_FILE_URL = re.compile(r"(file|local):(?=/)(?://([^/]*))?(/.*)?", re.IGNORECASE | re.DOTALL)


def local(text: str) -> str:
    """Return the path in a ``file:`` URL, without its percent-encoding. Other texts stay the same.

    >>> local("file:///renders/a%20b.exr"), local("file://localhost/a.exr"), local("s3://b/a.exr")
    ('/renders/a b.exr', '/a.exr', 's3://b/a.exr')

    Raises:
        RequestError: the URL contains no absolute path, or names another machine.
    """
    found = _FILE_URL.fullmatch(text) if ":/" in text[:7] else None
    if found is None:
        return text
    scheme, host, path = found[1], found[2] or "", found[3] or ""
    if host.lower() not in ("", "localhost"):
        raise RequestError(
            f"{one_line(text)}: found the machine '{one_line(host)}', but a {scheme} URL names a "
            f"file of this machine; use {scheme}:///PATH with an absolute path, or a plain path"
        )
    if not path:
        raise RequestError(
            f"{one_line(text)}: this URL has no path; use {scheme}:///PATH with an absolute path"
        )
    path = unquote(path, errors="surrogateescape")
    return path[1:] if os.name == "nt" and path[2:3] == ":" else path


def is_url(text: str) -> bool:
    """Return whether a text is a URL of something other than a file of this machine.

    >>> is_url("s3://renders/a.exr"), is_url("C:/renders"), is_url("file:///a.exr")
    (True, False, False)
    """
    return _URL.fullmatch(text) is not None and _FILE_URL.fullmatch(text) is None


def is_glob(url: str) -> bool:
    """Return whether a URL is a pattern. A "?" does not make it one: it starts a query."""
    return any(letter in name_in(url) for letter in "*[")


def name_in(url: str) -> str:
    """Return a URL without the archive that contains its file.

    >>> name_in("zip://a/b.exr::s3://bucket/c.zip")
    'zip://a/b.exr'
    """
    return url.partition("::")[0]


def local_path(name: str, text: str | Path) -> Path:
    """Return the path of a file that must be on this machine.

    Args:
        name: the option or key, for the message.
        text: a path, or a ``file:`` URL.

    Raises:
        RequestError: the text is another URL, or as for :func:`local`.
    """
    path = local(str(text))
    if is_url(path):
        raise RequestError(
            f"{name}: found the URL {one_line(path)}, but only images, manifests and tars may be "
            "at a URL; use a file of this machine"
        )
    return Path(path)
