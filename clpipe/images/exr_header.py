"""Reads the header of a usual OpenEXR file: one flat part, in one size, without subsampling.

OpenImageIO reads all others. The source for the layout is "OpenEXR File Layout", in the
documentation of the OpenEXR project.
"""

import os
import struct
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np

HEADER_BYTES = 1 << 16  # bytes; longer headers are unusual
ALLOWED_FLAGS = 0x600  # tiles, long names; other flags mean several parts or deep images
TYPES: dict[int, np.dtype[Any]] = {
    0: np.dtype(np.uint32),
    1: np.dtype(np.float16),
    2: np.dtype(np.float32),
}
CHUNK_ROWS = (1, 1, 1, 16, 32, 16, 32, 32, 32, 256)  # rows per chunk, by compression number


@dataclass(frozen=True)
class ExrHeader:
    """The types of channels by name, and the layout of chunks.

    Args:
        channels: the type of each channel, by name.
        columns: the width of a chunk in px; 0 if it equals the width of the image.
        rows: the height of a chunk in px.
        end: the header's length in bytes, after which the table of chunk offsets begins.
    """

    channels: dict[str, np.dtype[Any]]
    columns: int
    rows: int
    end: int


def read_header(path: Path, shape: tuple[int, int]) -> ExrHeader | None:
    """Return the header of a file; None if it is unusual, or chunks are missing or cut off.

    Args:
        path: the file.
        shape: rows and columns of its data window.
    """
    try:
        with path.open("rb") as file:
            header = _parse(file.read(HEADER_BYTES))
            return header if _has_all_chunks(file, header, shape) else None
    except (OSError, LookupError, ValueError, struct.error):
        return None


def _parse(start: bytes) -> ExrHeader:
    """Return the header at the start of a file.

    Raises:
        LookupError, ValueError, struct.error: it is unusual, or damaged.
    """
    if struct.unpack_from("<I", start, 4)[0] & ~ALLOWED_FLAGS != 2:
        raise ValueError
    values, offset = {}, 8
    while start[offset]:
        name, offset = _null_terminated(start, offset)
        kind, offset = _null_terminated(start, offset)
        (size,) = struct.unpack_from("<I", start, offset)
        # OpenEXR decompresses this attribute, to up to a thousand times its size.
        if kind == b"idmanifest":
            raise ValueError
        values[name] = start[offset + 4 : offset + 4 + size]
        offset += 4 + size
    columns, rows, mode = 0, CHUNK_ROWS[values[b"compression"][0]], 0
    if b"tiles" in values:
        columns, rows, mode = struct.unpack("<IIB", values[b"tiles"])
    if mode & 0xF:  # several sizes
        raise ValueError
    return ExrHeader(dict(_channels(values[b"channels"])), columns, rows, offset + 1)


def _channels(value: bytes) -> Iterator[tuple[str, np.dtype[Any]]]:
    """Yield the name and type of each channel.

    Raises:
        LookupError, ValueError, struct.error: one is subsampled, or the list is damaged.
    """
    offset = 0
    while value[offset]:
        name, offset = _null_terminated(value, offset)
        type_, *sampling = struct.unpack_from("<i4xii", value, offset)
        if sampling != [1, 1]:
            raise ValueError
        yield name.decode(), TYPES[type_]
        offset += 16


def _null_terminated(data: bytes, offset: int) -> tuple[bytes, int]:
    """Return the text that begins at an offset, and the offset after it."""
    end = data.index(0, offset)
    return data[offset:end], end + 1


def _has_all_chunks(file: BinaryIO, header: ExrHeader, shape: tuple[int, int]) -> bool:
    """Return whether all chunks are in the file, in ascending or descending order.

    Raises:
        LookupError, struct.error: they are not.
    """
    height, width = shape
    columns, chunk_header = (header.columns, 20) if header.columns else (width, 8)
    chunks = -(-height // header.rows) * -(-width // columns)
    file.seek(header.end)
    offsets = np.frombuffer(file.read(8 * chunks), "<u8")
    first, last = sorted((int(offsets[0]), int(offsets[-1])))
    ascending, size = offsets[1:] > offsets[:-1], file.seek(0, os.SEEK_END)
    in_order = len(offsets) == chunks and (ascending.all() or not ascending.any())
    if not in_order or first < header.end + 8 * chunks or last + chunk_header > size:
        return False
    file.seek(last + chunk_header - 4)
    (packed,) = struct.unpack("<I", file.read(4))
    return last + chunk_header + packed <= size
