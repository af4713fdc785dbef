"""Where files behind URLs lie while they are read."""

from pathlib import Path

from clpipe.base.buckets import is_url, place_of
from clpipe.base.errors import RequestError
from clpipe.engine.process_folder import process_folder


def place_of_url(url: str) -> Path:
    """The path that stands for a URL in this process's folder for temporary files.

    Raises:
        RequestError: there is no such folder, or no path can stand for it.
    """
    folder = process_folder()
    if folder is None:
        raise RequestError(f"{url}: there is no folder for temporary files with room (TMPDIR)")
    return place_of(url, folder)


def path_of(text: str) -> Path:
    """The path that a text names, or that stands for it where it is a URL; errors as above."""
    return place_of_url(text) if is_url(text) else Path(text)
