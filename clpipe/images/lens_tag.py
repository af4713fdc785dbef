"""Writes the lens's model to the EXIF of a JPEG or PNG, because OpenImageIO does not."""

import zlib

from PIL import Image

EXIF_IFD, LENS_MODEL = 0x8769, 0xA434
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


def _exif_range(file: bytes) -> tuple[int, int]:
    """Return the offsets at which the EXIF of a file begins and ends."""
    if file.startswith(PNG):
        offset = len(PNG)
        while True:
            size, kind = (
                int.from_bytes(file[offset : offset + 4], "big"),
                file[offset + 4 : offset + 8],
            )
            if kind == b"eXIf":
                return offset + 8, offset + 8 + size
            offset += 12 + size
    offset = 2
    while True:
        size = int.from_bytes(file[offset + 2 : offset + 4], "big")
        if file[offset + 1] == 0xE1 and file[offset + 4 : offset + 10] == HEADER:
            return offset + 4, offset + 2 + size
        offset += 2 + size
