"""Opening files with OpenImageIO, and its errors and threads."""

import contextlib
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import OpenImageIO as oiio

from clpipe.base.errors import ImageError
from clpipe.base.reading import check_regular
from clpipe.base.text import printable
from clpipe.base.types import Array

ERROR_LENGTH = 400  # characters; some repeat what they found, of any length

# How a file of each format begins. OpenImageIO would try its readers for twenty more, which see
# fewer damaged files than these do.
BEGINNINGS = (
    b"v/1\x01",  # OpenEXR
    b"#?",  # Radiance
    *(b"PF", b"Pf"),  # PFM
    *(b"II*\0", b"MM\0*", b"II+\0", b"MM\0+"),  # TIFF, BigTIFF
    b"\x89PNG",
    b"\xff\xd8\xff",  # JPEG
)


class SubsampledError(ImageError):
    """OpenImageIO cannot read a file, because its channels differ in size."""


def set_codec_threads(count: int) -> None:
    """Set how many threads OpenImageIO may use to read or write one file."""
    oiio.attribute("threads", count)
    oiio.attribute("exr_threads", count)


@contextlib.contextmanager
def open_image(path: Path) -> Iterator[Any]:
    """The file open as an ``oiio.ImageInput``.

    Raises:
        ImageError: the file is missing, no file, empty, damaged, or of no known format.
    """
    try:
        str(path).encode()
    except UnicodeEncodeError:
        raise ImageError(f"{str(path)!a}: its name is not UTF-8; rename it") from None
    try:
        size = check_regular(path).st_size
        with path.open("rb") as start:
            beginning = start.read(16)
    except FileNotFoundError:
        raise ImageError(f"{path}: no such file") from None
    except OSError as error:
        raise ImageError(f"{path}: cannot be read: {error.strerror}") from None
    if not size:
        raise ImageError(f"{path}: the file is empty")
    if not beginning.startswith(BEGINNINGS):
        raise ImageError(f"{path}: cannot be read as an image: {error_text('')}")
    try:
        hints = oiio.ImageSpec()
        hints.attribute("pnm:pfmflip", 1)  # else OpenImageIO 3.2 reads PFM upside down
        file = oiio.ImageInput.open(str(path), hints)
        if file is None:
            reason = error_text(oiio.geterror())
            failure = SubsampledError if reason.startswith("Subsampled channels") else ImageError
            raise failure(f"{path}: cannot be read as an image: {reason}")
        with contextlib.closing(file):
            yield file
    except UnicodeDecodeError:  # any call that returns text from the file can raise it
        raise ImageError(f"{path}: damaged: a name or attribute in it is not UTF-8") from None


def error_text(text: str) -> str:
    """An error of a library in one short line; it gives none for some damaged files."""
    if not text or "could not find a format reader" in text:
        return "it is damaged, or of no known format"
    line = printable(text)
    return line if len(line) <= ERROR_LENGTH else f"{line[:ERROR_LENGTH]}..."


def read_grey(path: Path) -> Array:
    """The first channel of a picture in whole numbers or floats, (height, width), as it is.

    Raises:
        ImageError: the file cannot be read.
    """
    with open_image(path) as file:
        pixels = file.read_image(0, 0, 0, 1)
        if pixels is None:
            raise ImageError(f"{path}: {error_text(file.geterror())}")
        return np.asarray(pixels)[..., 0]
