"""Adds what OpenImageIO does not write to the EXIF of a picture: the lens, and a thumbnail."""

import struct
import zlib
from io import BytesIO

import numpy as np
from PIL import Image

from clpipe.base.types import Array
from clpipe.images.tiff import directory_bytes, directory_size, long, short

EXIF_IFD, LENS_MODEL = 0x8769, 0xA434
THUMBNAIL = (160, 120)  # px, as Exif 2.3 (2010), 4.5.4, and DCF 2.0 (2010) have it
HEADER = b"Exif\0\0"
PNG = b"\x89PNG\r\n\x1a\n"


def with_lens_model(file: bytes, lens: str) -> bytes:
    """Return the bytes of a picture with the model of a lens added to its EXIF.

    Args:
        file: the bytes of a JPEG or PNG that has EXIF.
        lens: the model.
    """
    start, end = _exif_range(file)
    exif = Image.Exif()
    exif.load(file[start:end])
    exif.get_ifd(EXIF_IFD)[LENS_MODEL] = lens
    data = exif.tobytes()
    if not file.startswith(PNG):
        return file[: start - 2] + (len(data) + 2).to_bytes(2, "big") + data + file[end:]
    data = data.removeprefix(HEADER)
    checked = b"eXIf" + data
    size, check = len(data), zlib.crc32(checked)
    chunk = size.to_bytes(4, "big") + checked + check.to_bytes(4, "big")
    return file[: start - 8] + chunk + file[end + 4 :]


def with_thumbnail(file: bytes, pixels: Array) -> bytes:
    """Return the bytes of a JPEG with a thumbnail added to its EXIF, of at most 160x120 px.

    Args:
        file: the bytes of a JPEG whose EXIF is little-endian and has no thumbnail.
        pixels: its pixels, (height, width, 1 or 3), uint8.
    """
    step = max(max(pixels.shape[:2]) // (2 * THUMBNAIL[0]), 1)
    few = np.ascontiguousarray(pixels[::step, ::step])  # much faster than a mean of all
    small = Image.fromarray(few[..., 0] if few.shape[2] == 1 else few)
    small.thumbnail(THUMBNAIL, Image.Resampling.BOX)
    encoded = BytesIO()
    small.save(encoded, "JPEG", quality=75)
    picture = encoded.getvalue()
    start, end = _exif_range(file)
    tiff = bytearray(file[start + len(HEADER) : end])
    tiff += bytes(len(tiff) % 2)
    (first,) = struct.unpack_from("<I", tiff, 4)
    (fields,) = struct.unpack_from("<H", tiff, first)
    struct.pack_into("<I", tiff, first + 2 + 12 * fields, len(tiff))  # the second directory
    own = {259: short(6), 513: long(0), 514: long(len(picture))}  # a JPEG, its offset and its size
    own[513] = long(len(tiff) + directory_size(own))
    tiff += directory_bytes(own, len(tiff)) + picture
    size = (2 + len(HEADER) + len(tiff)).to_bytes(2, "big")
    return file[: start - 2] + size + HEADER + bytes(tiff) + file[end:]


def _exif_range(file: bytes) -> tuple[int, int]:
    """Return the offsets at which the EXIF of a file begins and ends."""
    with Image.open(BytesIO(file)) as image:
        exif = image.info["exif"]
    found = exif.removeprefix(HEADER) if file.startswith(PNG) else exif
    start = file.index(found)
    return start, start + len(found)
