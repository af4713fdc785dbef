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

HEADER_BYTES = 1 << 16  # longer headers are unusual
FLAGS = 0x600  # tiles, long names; other flags mean several parts or deep images
TYPES: dict[int, np.dtype[Any]] = {
    0: np.dtype(np.uint32),
    1: np.dtype(np.float16),
    2: np.dtype(np.float32),
}
ROWS = (1, 1, 1, 16, 32, 16, 32, 32, 32, 256)  # of a chunk, by the number of the compression


@dataclass(frozen=True)
class ExrHeader:
    """The types of channels by name, and the layout of chunks.

    Args:
        channels: the type of each channel, by name.
        columns: the width of a chunk in px; 0 if it is that of the image.
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
            header = _parsed(file.read(HEADER_BYTES))
            return header if _is_whole(file, header, shape) else None
    except (OSError, LookupError, ValueError, struct.error):
        return None


def _parsed(start: bytes) -> ExrHeader:
    """Return the header at the start of a file.

    Raises:
        LookupError, ValueError, struct.error: it is unusual, or damaged.
    """
    if struct.unpack_from("<I", start, 4)[0] & ~FLAGS != 2:
        raise ValueError
    values, at = {}, 8
    while start[at]:
        name, at = _text(start, at)
        kind, at = _text(start, at)
        (size,) = struct.unpack_from("<I", start, at)
        if kind == b"idmanifest":  # the package decompresses it, to up to a thousand times its size
            raise ValueError
        values[name] = start[at + 4 : at + 4 + size]
        at += 4 + size
    columns, rows, mode = 0, ROWS[values[b"compression"][0]], 0
    if b"tiles" in values:
        columns, rows, mode = struct.unpack("<IIB", values[b"tiles"])
    if mode & 0xF:  # several sizes
        raise ValueError
    return ExrHeader(dict(_channels(values[b"channels"])), columns, rows, at + 1)


def _channels(value: bytes) -> Iterator[tuple[str, np.dtype[Any]]]:
    """Yield the name and type of each channel.

    Raises:
        LookupError, ValueError, struct.error: one is subsampled, or the list is damaged.
    """
    at = 0
    while value[at]:
        name, at = _text(value, at)
        type_, *sampling = struct.unpack_from("<i4xii", value, at)
        if sampling != [1, 1]:
            raise ValueError
        yield name.decode(), TYPES[type_]
        at += 16


def _text(data: bytes, at: int) -> tuple[bytes, int]:
    """Return the text that begins at an offset, and the offset after it."""
    end = data.index(0, at)
    return data[at:end], end + 1


def _is_whole(file: BinaryIO, header: ExrHeader, shape: tuple[int, int]) -> bool:
    """Return whether all chunks are in the file, in ascending or descending order.

    Raises:
        LookupError, struct.error: they are not.
    """
    height, width = shape
    columns, leader = (header.columns, 20) if header.columns else (width, 8)
    chunks = -(-height // header.rows) * -(-width // columns)
    file.seek(header.end)
    places = np.frombuffer(file.read(8 * chunks), "<u8")
    first, last = sorted((int(places[0]), int(places[-1])))
    up, size = places[1:] > places[:-1], file.seek(0, os.SEEK_END)
    in_order = len(places) == chunks and (up.all() or not up.any())
    if not in_order or first < header.end + 8 * chunks or last + leader > size:
        return False
    file.seek(last + leader - 4)
    (packed,) = struct.unpack("<I", file.read(4))
    return last + leader + packed <= size
