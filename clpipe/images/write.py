"""Writes pictures: JPEG, PNG and TIFF with EXIF and an ICC profile, float OpenEXR, and ``.npy``."""

import errno
import mmap
import os
from collections.abc import Callable, Mapping, Sequence
from functools import cache
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np
import OpenImageIO as oiio
from PIL import ImageCms

from clpipe.base.about import __version__
from clpipe.base.cpu_time import CpuTimer
from clpipe.base.errors import ImageError
from clpipe.base.files import Stored, write_atomic
from clpipe.base.system import max_file_size, temporary_file
from clpipe.base.types import Array, Floats
from clpipe.images.attributes import PREFIX
from clpipe.images.encoding import Encoding
from clpipe.images.exif_block import with_lens_model, with_thumbnail
from clpipe.images.openexr import write_channels
from clpipe.images.openimageio import error_text
from clpipe.images.pixels import HALF_MAX
from clpipe.images.tags import Tags, exif
from clpipe.reference.geometry import NO_MARGINS, Margins

JPEG_MAX_SIDE = 65500
LENS, NO_LENS = "Exif:LensModel", ("jpg", "png")  # OpenImageIO omits the tag in these formats
THUMBNAIL_FROM = 1024  # px, width or height; smaller JPEGs, such as crops for training, have none
# Without a time, OpenImageIO adds the current one, and the bytes would differ in each run.
NO_TIME = "1970:01:01 00:00:00"


@cache
def srgb_profile() -> bytes:
    """Return an ICC profile of sRGB, with the same bytes in each call."""
    profile = bytearray(ImageCms.ImageCmsProfile(ImageCms.createProfile("sRGB")).tobytes())
    profile[24:36] = bytes(12)  # removes the date of creation
    return bytes(profile)


def write_display(path: Path, pixels: Array, tags: Tags) -> Stored:
    """Write a picture, (height, width[, 3]), as JPEG, PNG or TIFF, with EXIF.

    Integers of 8 or 16 bits get an sRGB profile, and float samples (TIFF) do not.
    ``tags.encoding`` sets the encoding of a JPEG or PNG. The EXIF of a TIFF lacks the ISO, because
    OpenImageIO cannot write it.

    Raises:
        ImageError: the file cannot be written.
    """
    height, width = pixels.shape[:2]
    channels = pixels.shape[2] if pixels.ndim == 3 else 1
    samples = "float" if pixels.dtype.kind == "f" else pixels.dtype.name
    spec = oiio.ImageSpec(width, height, channels, samples)
    encoding = tags.encoding
    jpeg = path.suffix == ".jpg"
    spec.attribute("compression", f"jpeg:{encoding.jpeg_quality}" if jpeg else "zip")
    spec.attribute("png:compressionLevel", encoding.png_compression)
    if jpeg:
        spec.attribute("jpeg:subsampling", encoding.jpeg_subsampling)
        spec.attribute("jpeg:progressive", int(encoding.jpeg_progressive))
    if channels == 3 and pixels.dtype.kind == "u":
        icc = np.frombuffer(srgb_profile(), np.uint8)
        spec.attribute("ICCProfile", oiio.TypeDesc(f"uint8[{len(icc)}]"), icc)
        spec.attribute("Exif:ColorSpace", 1)  # sRGB
    spec.attribute("Make", tags.make)
    spec.attribute("Model", tags.model)
    spec.attribute("Software", f"clpipe {__version__}")
    for name, value in exif(tags, height, width).items():
        if name == "ExposureTime":
            # OpenImageIO truncates after the sixth digit, and 0.01 is 0.0099999998 as float32.
            above = float(np.nextafter(np.float32(value), np.float32(np.inf)))
            spec.attribute(name, above)
        else:
            spec.attribute(name if name == "FNumber" else f"Exif:{name}", value)
    if tags.taken or path.suffix == ".tif":
        spec.attribute("DateTime", tags.taken or NO_TIME)
    return _write(path, spec, pixels.reshape(height, width, channels))


def write_exr(
    path: Path,
    pixels: Floats,
    channels: Sequence[str],
    attributes: Mapping[str, str],
    half: bool = False,
    margins: Margins = NO_MARGINS,
) -> Stored:
    """Write a float image, (height, width[, channel]), as OpenEXR with ZIP compression.

    Args:
        path: the file.
        pixels: the samples.
        channels: the names of the channels.
        attributes: clpipe's own attributes; their names get clpipe's prefix in the file.
        half: whether to write half floats: 11 bits, clipped to -65504..65504.
        margins: the overscan of the image. The display window excludes it.

    Raises:
        ImageError: the file cannot be written.
    """
    height, width = pixels.shape[:2]
    spec = oiio.ImageSpec(width, height, len(channels), oiio.HALF if half else oiio.FLOAT)
    spec.x, spec.y = -margins.left, -margins.top
    spec.full_width, spec.full_height = margins.frame_size(width, height)
    spec.channelnames = tuple(channels)
    spec.attribute("compression", "zip")
    spec.attribute("DateTime", NO_TIME)
    for name, value in attributes.items():
        spec.attribute(PREFIX + name, value)
    data = np.clip(pixels, -HALF_MAX, HALF_MAX) if half else pixels
    return _write(path, spec, data.reshape(height, width, len(channels)))


def write_npy(path: Path, array: Array) -> Stored:
    """Write an array as NumPy's ``.npy``, version 1.0 (NEP 1), C-contiguous.

    After the header's dictionary, which Python reads, a comment names clpipe.

    Raises:
        ImageError: the file cannot be written.
    """
    array = np.ascontiguousarray(array)
    text = repr(np.lib.format.header_data_from_array_1_0(array)) + f"  # clpipe {__version__}"
    prefix_size = len(np.lib.format.MAGIC_PREFIX) + 4  # the version, and the length of the header
    padded = text + " " * (-(prefix_size + len(text) + 1) % 64) + "\n"
    header = np.lib.format.magic(1, 0) + len(padded).to_bytes(2, "little") + padded.encode()
    return write_atomic(path, header, array.data.cast("B"))


def write_planes(path: Path, planes: Mapping[str, Array], attributes: Mapping[str, str]) -> Stored:
    """Write channels as OpenEXR with ZIP compression, each in its own type.

    Args:
        path: the file.
        planes: (height, width) float16, float32 or uint32, by the names of the channels.
        attributes: attributes of the header, by their full names.

    Raises:
        ImageError: the file cannot be written.
    """

    def encode(to: str) -> None:
        write_channels(to, planes, attributes)

    return _stored(path, sum(plane.nbytes for plane in planes.values()), encode)


def write_png(path: Path, pixels: Array) -> Stored:
    """Write integers of 8 or 16 bits, (height, width[, 3]), as PNG without EXIF.

    Raises:
        ImageError: the file cannot be written.
    """
    samples = pixels if pixels.ndim == 3 else pixels[..., np.newaxis]
    height, width, channels = samples.shape
    spec = oiio.ImageSpec(width, height, channels, samples.dtype.name)
    spec.attribute("png:compressionLevel", Encoding().png_compression)
    spec.attribute("Software", f"clpipe {__version__}")
    return _write(path, spec, samples)


def _write(path: Path, spec: Any, pixels: Array) -> Stored:
    """Write (height, width, channel) with OpenImageIO, which releases the GIL while it encodes.

    Raises:
        ImageError: the file cannot be written.
    """
    return _stored(path, pixels.nbytes, lambda to: _encode(path.suffix[1:], to, spec, pixels))


def _stored(path: Path, size: int, encode: Callable[[str], None]) -> Stored:
    """Encode a picture, and write it as a whole.

    Args:
        path: the file.
        size: the size of the samples in bytes.
        encode: encodes to a path; raises OSError if it cannot.

    Raises:
        ImageError: the file cannot be written.
    """
    # Encoders do not notice every error of a full disk, and libjpeg then ends the process. Encoders
    # therefore write to memory, or to a disk with enough space.
    try:
        _check_file_limit(2 * size)
        with temporary_file(2 * size) as to:
            encode(to)
            with (
                open(to, "rb", buffering=0) as file,
                mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as encoded,
                memoryview(encoded) as data,
            ):
                return write_atomic(path, data)
    except OSError as error:
        raise ImageError(f"{path}: cannot be written: {error.strerror or error}") from None


def _check_file_limit(size: int) -> None:
    """Check that the process may write files of a size (``ulimit -f``), which also limits memory.

    Raises:
        OSError: it may not.
    """
    limit = max_file_size()
    if limit is not None and size > limit:
        raise OSError(errno.EFBIG, f"{os.strerror(errno.EFBIG)} (ulimit -f)")


@CpuTimer("encode")
def _encode(format_: str, to: str, spec: Any, pixels: Array) -> None:
    """Encode pixels to a file.

    Args:
        format_: the extension of the format.
        to: the path to write to.
        spec: the ``oiio.ImageSpec``.
        pixels: (height, width, channel).

    Raises:
        OSError: the file cannot be written.
    """
    file = oiio.ImageOutput.create(format_)
    data = np.ascontiguousarray(pixels)
    if file is None or not file.open(to, spec) or not file.write_image(data):
        raise OSError(0, error_text(file.geterror() if file else oiio.geterror()))
    if not file.close():
        raise OSError(0, error_text(file.geterror()))
    lens = format_ in NO_LENS and spec.getattribute(LENS)
    has_thumbnail = format_ == "jpg" and max(data.shape) >= THUMBNAIL_FROM
    if lens or has_thumbnail:
        encoded = Path(to).read_bytes()
        encoded = with_lens_model(encoded, lens) if lens else encoded
        Path(to).write_bytes(with_thumbnail(encoded, data) if has_thumbnail else encoded)


@cache
def versions() -> dict[str, str]:
    """Return the versions of the libraries that read and write pictures."""
    return {name: version(name) for name in ("OpenImageIO", "OpenEXR", "Pillow", "rawpy")}
