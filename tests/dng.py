"""A DNG writer for tests, which can also write invalid values."""

import struct
from pathlib import Path

import numpy as np

from clpipe.images import tiff

# A camera's colours at D65, as DNG's ColorMatrix2 has them.
MATRIX = ((0.4716, 0.0603, -0.0830), (-0.7798, 1.5474, 0.2480), (-0.1496, 0.1937, 0.6651))


def field(tag: int, type_: int, *values) -> tuple[int, tiff.Field]:
    """A TIFF field; text is given as bytes."""
    if type_ == 2:
        return tag, tiff.Field(2, len(values[0]) + 1, values[0] + b"\0")
    return tag, tiff.MAKERS[type_](*values)


def write_dng(
    path: Path,
    dn: np.ndarray,
    pattern: str = "RGGB",
    *,
    orientation: int = 1,
    black: tuple[float, ...] = (512, 512, 512, 512),
    white: int = 16383,
    neutral: tuple[float, float, float] = (0.5, 1, 0.625),
    matrix=MATRIX,
    make: bytes = b"Canon",
    model: bytes = b"Canon EOS 5D Mark II",
    iso: int = 400,
    changes=(),
) -> Path:
    """A DNG of 16 bits, uncompressed: (height, width) is a mosaic, (height, width, 3) LinearRaw.

    ``changes`` are fields that replace others, or come in addition.
    """
    dn = np.asarray(dn, "<u2")
    channels = dn.shape[2] if dn.ndim == 3 else 1
    fields = [
        field(254, 4, 0),
        field(256, 4, dn.shape[1]),
        field(257, 4, dn.shape[0]),
        field(258, 3, *[16] * channels),
        field(259, 3, 1),
        field(262, 3, 32803 if channels == 1 else 34892),
        field(271, 2, make),
        field(272, 2, model),
        field(274, 3, orientation),
        field(277, 3, channels),
        field(278, 4, dn.shape[0]),
        field(279, 4, dn.nbytes),
        field(306, 2, b"2024:05:06 07:08:09"),
        field(33434, 5, 1 / 50),
        field(33437, 5, 2.8),
        field(34855, 3, iso),
        field(37386, 5, 35),
        field(50706, 1, 1, 4, 0, 0),
        field(50708, 2, model),
        field(50717, 4, *[white] * channels),
        field(50728, 10, *neutral),
        field(50778, 3, 21),
    ]
    if matrix is not None:
        fields.append(field(50721, 10, *np.ravel(matrix).tolist()))
    if channels == 1:
        fields.append(field(33421, 3, 2, 2))
        fields.append(field(33422, 1, *("RGB".index(c) for c in pattern)))
        fields.append(field(50713, 3, 2, 2))
        fields.append(field(50714, 5, *black))
    directory = {**dict(fields), **dict(changes), 273: tiff.long(0)}
    directory[273] = tiff.long(8 + tiff.directory_size(directory))
    head = b"II*\0" + struct.pack("<I", 8) + tiff.directory_bytes(directory, 8)
    path.write_bytes(head + dn.tobytes())
    return path
