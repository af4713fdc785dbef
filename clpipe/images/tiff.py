"""The bytes of a TIFF file: fields and directories, written little-endian (TIFF 6.0, 1992).

A function named after a TIFF type makes a field of that type from its values.
"""

import struct
from collections.abc import Callable, Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass
from fractions import Fraction
from functools import partial
from itertools import chain, islice
from pathlib import Path
from typing import Any, BinaryIO

from clpipe.base.types import Array


@dataclass(frozen=True)
class Field:
    """A field of a directory: its TIFF type, the number of its values, and their bytes."""

    type: int
    count: int
    data: bytes

    @property
    def padded(self) -> int:
        """The bytes that the values take outside the directory: 0 for up to four."""
        return 0 if len(self.data) <= 4 else len(self.data) + len(self.data) % 2


Directory = dict[int, Field]  # fields by tag number

# Codes of TIFF's types for :mod:`struct`: bytes, text, numbers, fractions, signed ones, floats, and
# those of BigTIFF.
CODES = {1: "B", 2: "B", 3: "H", 4: "I", 5: "II", 6: "b", 7: "B", 8: "h", 9: "i", 10: "ii"}
CODES |= {11: "f", 12: "d", 13: "I", 16: "Q", 17: "q", 18: "Q"}
TEXT = 2
BIG_TIFF = 43  # the version of files with offsets of 64 bits
PARTS = (34665, 330)  # tags with the offsets of other directories: ExifIFD, SubIFDs
MOST_DIRECTORIES = 64
MOST_BYTES = 1 << 16  # of the values of a field; more are left out
MOST_VALUES = 1 << 20  # of a file; more take too much time


def _field(type_: int, *values: float) -> Field:
    code = CODES[type_]
    pairs = map(fraction, values) if len(code) == 2 else zip(values)
    data = struct.pack("<" + code * len(values), *chain.from_iterable(pairs))
    return Field(type_, len(values), data)


MAKERS = {type_: partial(_field, type_) for type_ in (1, 3, 4, 5, 10, 11, 12)}
byte, short, long, rational, signed_rational, float32, double = MAKERS.values()


def text(value: str) -> Field:
    """Return an ASCII field: text, with ? for other characters, and a final NUL."""
    data = value.encode("ascii", "replace") + b"\0"
    return Field(TEXT, len(data), data)


def fraction(value: float) -> tuple[int, int]:
    """Return the fraction nearest to a number, with 31 bits for numerator and denominator.

    >>> fraction(1 / 2.77), fraction(-0.4618), fraction(1e7)
    ((100, 277), (-2309, 5000), (10000000, 1))
    """
    largest = min(1_000_000, int((2**31 - 1) / max(abs(value), 1.0)))
    nearest = Fraction(value).limit_denominator(max(largest, 1))
    return nearest.numerator, nearest.denominator


def directory_size(fields: Directory) -> int:
    """Return the size in bytes of a directory and the values after it."""
    return 6 + 12 * len(fields) + sum(field.padded for field in fields.values())


def directory_bytes(fields: Directory, offset: int) -> bytes:
    """Return the bytes of a directory at ``offset`` in the file, and of the values after it."""
    head, values = struct.pack("<H", len(fields)), b""
    values_offset = offset + 6 + 12 * len(fields)
    for tag, field in sorted(fields.items()):
        value = field.data.ljust(4, b"\0")
        if field.padded:
            value = struct.pack("<I", values_offset + len(values))
            values += field.data.ljust(field.padded, b"\0")
        head += struct.pack("<HHI", tag, field.type, field.count) + value
    return head + struct.pack("<I", 0) + values


def image_fields(pixels: Array, subfile_type: int, photometric: int) -> Directory:
    """Return the fields of an uncompressed image. The offset of its strip is 0 until it is known.

    Args:
        pixels: (height, width[, channel]).
        subfile_type: 0 for the image itself, 1 for a smaller version of it.
        photometric: the value of PhotometricInterpretation.
    """
    height, width = pixels.shape[:2]
    samples = pixels.shape[2] if pixels.ndim == 3 else 1
    return {
        254: long(subfile_type),  # NewSubfileType
        256: long(width),  # ImageWidth
        257: long(height),  # ImageLength
        258: short(*[pixels.itemsize * 8] * samples),  # BitsPerSample
        259: short(1),  # Compression: none
        262: short(photometric),  # PhotometricInterpretation
        273: long(0),  # StripOffsets
        277: short(samples),  # SamplesPerPixel
        278: long(height),  # RowsPerStrip: all rows
        279: long(pixels.nbytes),  # StripByteCounts
        284: short(1),  # PlanarConfiguration: interleaved
    }


def exif_fields(tags: Mapping[str, float | str]) -> Directory:
    """Return the EXIF directory; ``tags`` are those of :func:`clpipe.images.tags.exif`."""
    types: dict[str, tuple[int, Callable[..., Field]]] = {
        "ExposureTime": (33434, rational),
        "FNumber": (33437, rational),
        "ExposureBiasValue": (37380, signed_rational),
        "SubjectDistance": (37382, rational),
        "LensModel": (42036, text),
        "PhotographicSensitivity": (34855, short),
        "DateTimeOriginal": (36867, text),
        "FocalLength": (37386, rational),
        "FocalPlaneXResolution": (41486, rational),
        "FocalPlaneYResolution": (41487, rational),
        "FocalPlaneResolutionUnit": (41488, short),
        "FocalLengthIn35mmFilm": (41989, short),
    }
    fields = {36864: Field(7, 4, b"0230")}  # ExifVersion
    for name, value in tags.items():
        tag, make_field = types[name]
        fields[tag] = make_field(value)
    return fields


def read_directories(source: Path | BinaryIO) -> Iterator[dict[int, tuple[Any, ...]]]:
    """Yield the values of a TIFF's first directory by their tags, then those of its parts.

    The parts are its EXIF, then images. Text is one value. Directories that are damaged, or of
    another format, are left out, because the reader of the pixels reports it better.
    """
    with (
        suppress(OSError, ValueError, LookupError, OverflowError, struct.error),
        source.open("rb") if isinstance(source, Path) else source as file,
    ):
        start = file.read(16)
        order = {b"II": "<", b"MM": ">"}[start[:2]]
        (version,) = struct.unpack_from(f"{order}H", start, 2)
        big = version == BIG_TIFF  # other numbers are TIFF's and those of raws such as ORF and RW2
        offsets = [struct.unpack_from(f"{order}{'Q' if big else 'I'}", start, 8 if big else 4)[0]]
        remaining = MOST_VALUES
        for offset in islice(offsets, MOST_DIRECTORIES):
            directory = _read_directory(file, offset, order, big, remaining)
            remaining -= sum(map(len, directory.values()))
            for tag in PARTS:
                offsets += map(int, directory.get(tag, ()))
            yield directory


def _read_directory(
    file: BinaryIO, offset: int, order: str, big: bool, most_values: int
) -> dict[int, tuple[Any, ...]]:
    """Return the values of a directory by their tags.

    Raises:
        OSError, ValueError, LookupError, OverflowError, struct.error: it is damaged, or has more
            than ``most_values``.
    """
    count_code, entry_code, inside = ("Q", "HHQ8s", 8) if big else ("H", "HHI4s", 4)
    file.seek(offset)
    (count,) = struct.unpack(f"{order}{count_code}", file.read(8 if big else 2))
    entries = file.read(min(count, 1 << 16) * (20 if big else 12))
    found: dict[int, tuple[Any, ...]] = {}
    for tag, type_, number, data in struct.iter_unpack(f"{order}{entry_code}", entries):
        code = CODES.get(type_, "")
        count = min(number, MOST_BYTES) if code else 0
        most_values -= count
        if most_values < 0:
            raise ValueError
        size = struct.calcsize(order + code) * count
        content = data[:size]
        if size > inside:
            file.seek(struct.unpack(f"{order}{'Q' if big else 'I'}", data)[0])
            content = file.read(size)
        values = struct.unpack(order + code * count, content)
        if type_ == TEXT:
            values = (content.partition(b"\0")[0].decode(errors="replace"),)
        elif len(code) == 2:
            fractions = zip(values[::2], values[1::2], strict=True)
            values = tuple(above / below if below else 0.0 for above, below in fractions)
        found[tag] = values
    return found
