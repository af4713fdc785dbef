"""Opening files with OpenImageIO, and its errors and threads."""

import contextlib
import re
import shutil
import tempfile
from collections.abc import Iterator
from contextlib import nullcontext
from pathlib import Path
from typing import Any

import numpy as np
import OpenImageIO as oiio
from PIL import Image

from clpipe.base.errors import ImageError
from clpipe.base.reading import check_regular, read_errors
from clpipe.base.text import printable
from clpipe.base.types import Array
from clpipe.images import pfm, radiance

MAX_PARTS = 1000  # parts of a file that are searched
ERROR_LENGTH = 400  # characters; some repeat what they found, of any length

# The first bytes of each format. OpenImageIO would try the readers of twenty more formats, which
# are less tested with damaged files. A Targa file has no such bytes.
SIGNATURES = (
    b"v/1\x01",  # OpenEXR
    radiance.MAGIC,
    *pfm.MAGICS,
    *(b"II*\0", b"MM\0*", b"II+\0", b"MM\0+"),  # TIFF, BigTIFF
    b"\x89PNG",
    b"\xff\xd8\xff",  # JPEG
    b"BM",  # BMP
    b"RIFF",  # WebP
)
TEXT_HEADERS = (radiance.MAGIC, *pfm.MAGICS)
TARGA = ".tga"
FORMATS_READ = "OpenEXR, Radiance HDR, PFM, TIFF, PNG, JPEG, BMP, Targa and WebP"

# Formats that are not read, by the offset and value of identifying bytes.
UNSUPPORTED = {
    (0, b"GIF8"): "GIF",
    (0, b"\0\0\0\x0cjP"): "JPEG 2000",
    (0, b"\xffO\xffQ"): "JPEG 2000",
    (0, b"\0\0\0\x0cJXL "): "JPEG XL",
    (0, b"\xff\x0a"): "JPEG XL",
    (4, b"ftypheic"): "HEIC",
    (4, b"ftypheix"): "HEIC",
    (4, b"ftypmif1"): "HEIF",
    (4, b"ftypavif"): "AVIF",
    (0, b"8BPS"): "Photoshop",
    (0, b"SDPX"): "DPX",
    (0, b"XPDS"): "DPX",
    (0, b"\x80*_\xd7"): "Cineon",
    (0, b"DDS "): "DDS",
    (0, b"%PDF"): "PDF",
    **{(0, b"P%d" % i): "PNM" for i in range(1, 8)},
}


class SubsampledError(ImageError):
    """OpenImageIO cannot read a file, because its channels differ in size."""


def set_codec_threads(count: int) -> None:
    """Set the number of threads with which OpenImageIO may read or write one file."""
    oiio.attribute("threads", count)
    oiio.attribute("exr_threads", count)


@contextlib.contextmanager
def open_image(path: Path) -> Iterator[Any]:
    """Open a file as an ``oiio.ImageInput``.

    Raises:
        ImageError: the file is missing, not a file, empty, damaged, or in an unknown format.
    """
    try:
        str(path).encode()
    except UnicodeEncodeError:
        raise ImageError(f"{str(path)!a}: its name is not UTF-8; rename it") from None
    try:
        size = check_regular(path).st_size
        with path.open("rb") as start:
            signature = start.read(16)
    except FileNotFoundError:
        raise ImageError(f"{path}: no such file") from None
    except OSError as error:
        raise ImageError(f"{path}: cannot be read: {error.strerror}") from None
    if not size:
        raise ImageError(f"{path}: the file is empty")
    if not signature.startswith(SIGNATURES) and path.suffix.lower() != TARGA:
        raise ImageError(f"{path}: cannot be read as an image: {_format_problem(signature)}")
    try:
        hints = oiio.ImageSpec()
        hints.attribute("pnm:pfmflip", 1)  # without it, OpenImageIO 3.2 reads PFM upside down
        hints.attribute("oiio:UnassociatedAlpha", 1)  # do not multiply encoded values by alpha
        # OpenImageIO may misread files with a text header.
        has_text = signature.startswith(TEXT_HEADERS)
        with _readable_copy(path, signature, size) if has_text else nullcontext(path) as readable:
            file = oiio.ImageInput.open(str(readable), hints)
            if file is None:
                reason = error_text(oiio.geterror())
                is_subsampled = reason.startswith("Subsampled channels")
                failure = SubsampledError if is_subsampled else ImageError
                raise failure(f"{path}: cannot be read as an image: {reason}")
            with contextlib.closing(file):
                yield file
    except UnicodeDecodeError:  # any call that returns text from the file can raise it
        raise ImageError(f"{path}: damaged: a name or attribute in it is not UTF-8") from None


def _format_problem(signature: bytes) -> str:
    """Return why a file with these first bytes is not read."""
    if signature.startswith(b"\x93NUMPY"):
        return "it is a NumPy array, not an image file; write its pixels as an OpenEXR file"
    for (offset, mark), name in UNSUPPORTED.items():
        if signature[offset:].startswith(mark):
            return (
                f"it is a {name} file; clpipe reads {FORMATS_READ}. Convert it with ImageMagick or "
                "OpenImageIO's oiiotool, for example to PNG or TIFF"
            )
    return error_text("")


@contextlib.contextmanager
def _readable_copy(path: Path, signature: bytes, size: int) -> Iterator[Path]:
    """Yield the file, or a temporary copy with another header if OpenImageIO misreads its own."""
    header: radiance.RadianceHeader | pfm.PfmHeader | None = None
    if signature.startswith(radiance.MAGIC):
        radiance_ = radiance_header(path)
        header = None if radiance_.is_standard else radiance_
    else:
        with path.open("rb") as file:
            header = pfm.pfm_header(file.read(radiance.HEADER_BYTES), size)
    if header is None:
        yield path
        return
    with tempfile.NamedTemporaryFile(suffix=path.suffix) as copy:
        with path.open("rb") as file:
            file.seek(header.end)
            copy.write(header.standard)
            shutil.copyfileobj(file, copy)
        copy.flush()
        yield Path(copy.name)


def parts_of(file: Any) -> Iterator[tuple[int, str, Any]]:
    """Yield the number of each part of an open file, its name and its ``oiio.ImageSpec``.

    The file is at that part. The only part of a file has no name. The first :data:`MAX_PARTS` and
    one more are yielded, because the time to reach a part grows with the number of parts before it.
    """
    several = file.seek_subimage(1, 0)
    for part in range(MAX_PARTS + 1):
        if not file.seek_subimage(part, 0):
            break
        spec = file.spec()
        yield part, str(spec.getattribute("oiio:subimagename") or "") if several else "", spec
    file.geterror()  # clears the error: the loop asked for a part that does not exist


def radiance_header(path: Path) -> radiance.RadianceHeader:
    """Return the header of a Radiance picture.

    Raises:
        ImageError: the header is damaged, or the file cannot be read.
    """
    with read_errors(path), path.open("rb") as file:
        data = file.read(radiance.HEADER_BYTES)
    try:
        return radiance.radiance_header(data)
    except ImageError as error:
        raise ImageError(f"{path}: {error}") from None


def error_text(text: str) -> str:
    """Return a library's error in one short line. For some damaged files, the error is empty."""
    if not text or "could not find a format reader" in text:
        return f"it is damaged, or in an unknown format; clpipe reads {FORMATS_READ}"
    line = printable(text)
    return line if len(line) <= ERROR_LENGTH else f"{line[:ERROR_LENGTH]}..."


UNREAD_COMPRESSION = re.compile(r"(\w+) compression support is not configured|scheme (\d+) ")


def damage_text(text: str) -> str:
    """Return why samples of an open file could not be read, from OpenImageIO's error.

    >>> damage_text("TIFFReadEncodedStrip failed: LERC compression support is not configured")[:32]
    'its compression, LERC, cannot be'
    """
    if found := UNREAD_COMPRESSION.search(text):
        return (
            f"its compression, {found[1] or f'TIFF scheme {found[2]}'}, cannot be decoded by this "
            "build of OpenImageIO. Write the file with another compression, such as ZIP or LZW, "
            "for example with ImageMagick: magick IN -compress zip OUT"
        )
    return f"damaged: {error_text(text)}"


def read_with_pillow(path: Path, spec: Any, part: int, type_: Any) -> Array | None:
    """Read an 8-bit TIFF whose compression OpenImageIO lacks, (height, width, channel).

    Args:
        path: the file.
        spec: OpenImageIO's spec of the page.
        part: the number of the page.
        type_: ``oiio.FLOAT`` scales samples to 0..1; other types do not change them.

    Returns:
        The samples; None if Pillow cannot read them either.
    """
    if spec.format.basetype != oiio.UINT8 or spec.getattribute("tiff:Compression") is None:
        return None
    try:
        with Image.open(path) as file:
            file.seek(part)
            samples = np.asarray(file).reshape(spec.height, spec.width, spec.nchannels)
    except (OSError, ValueError, SyntaxError):
        return None
    return samples / np.float32(255) if type_ == oiio.FLOAT else samples
