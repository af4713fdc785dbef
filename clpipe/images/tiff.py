"""TODO."""

import struct
from collections.abc import Callable
from dataclasses import dataclass
from fractions import Fraction

from clpipe.base.types import Array


def rational(value: float) -> tuple[int, int]:
    """A number as EXIF has it: two whole numbers of 31 bits, as near as they come.

    >>> rational(1 / 2.77), rational(-0.4618), rational(1e7)
    ((100, 277), (-2309, 5000), (10000000, 1))
    """
    largest = min(1_000_000, int((2**31 - 1) / max(abs(value), 1.0)))
    found = Fraction(value).limit_denominator(max(largest, 1))
    return found.numerator, found.denominator


@dataclass(frozen=True)
class Field:
    """A field of a TIFF directory (TIFF 6.0, 1992): its type, how many values, their bytes."""

    type: int
    count: int
    data: bytes

    @property
    def padded(self) -> int:
        """The bytes that it takes outside the directory."""
        return 0 if len(self.data) <= 4 else len(self.data) + len(self.data) % 2


Directory = dict[int, Field]


def _byte(*values: int) -> Field:
    return Field(1, len(values), bytes(values))


def _text(text: str) -> Field:
    data = text.encode("ascii", "replace") + b"\0"
    return Field(2, len(data), data)


def _short(*values: int) -> Field:
    return Field(3, len(values), struct.pack(f"<{len(values)}H", *values))


def _long(*values: int) -> Field:
    return Field(4, len(values), struct.pack(f"<{len(values)}I", *values))


def _rational(*values: float) -> Field:
    pairs = [part for value in values for part in rational(value)]
    return Field(5, len(values), struct.pack(f"<{len(pairs)}I", *pairs))


def _signed_rational(*values: float) -> Field:
    pairs = [part for value in values for part in rational(value)]
    return Field(10, len(values), struct.pack(f"<{len(pairs)}i", *pairs))


def _double(*values: float) -> Field:
    return Field(12, len(values), struct.pack(f"<{len(values)}d", *values))


def _size(fields: Directory) -> int:
    return 6 + 12 * len(fields) + sum(field.padded for field in fields.values())


def _packed(fields: Directory, at: int) -> bytes:
    """A directory that stands ``at`` bytes into the file, with the values of its fields."""
    head, rest = struct.pack("<H", len(fields)), b""
    after = at + 6 + 12 * len(fields)
    for tag, field in sorted(fields.items()):
        value = field.data.ljust(4, b"\0")
        if field.padded:
            value = struct.pack("<I", after + len(rest))
            rest += field.data.ljust(field.padded, b"\0")
        head += struct.pack("<HHI", tag, field.type, field.count) + value
    return head + struct.pack("<I", 0) + rest


def _image(pixels: Array, kind: int, photometric: int) -> Directory:
    """What any picture in a TIFF says of itself; its place is 0 until it is known."""
    height, width = pixels.shape[:2]
    samples = pixels.shape[2] if pixels.ndim == 3 else 1
    return {
        254: _long(kind),  # 0: the picture itself, 1: a smaller one
        256: _long(width),
        257: _long(height),
        258: _short(*[pixels.itemsize * 8] * samples),
        259: _short(1),  # not compressed
        262: _short(photometric),
        273: _long(0),
        277: _short(samples),
        278: _long(height),  # rows, all in one strip
        279: _long(pixels.nbytes),
        284: _short(1),  # samples side by side
    }


def _exif_directory(tags: dict[str, float]) -> Directory:
    of: dict[str, tuple[int, Callable[..., Field]]] = {
        "ExposureTime": (33434, _rational),
        "PhotographicSensitivity": (34855, _short),
        "FocalLength": (37386, _rational),
        "FocalPlaneXResolution": (41486, _rational),
        "FocalPlaneYResolution": (41487, _rational),
        "FocalPlaneResolutionUnit": (41488, _short),
        "FocalLengthIn35mmFilm": (41989, _short),
    }
    fields = {36864: Field(7, 4, b"0230")}  # ExifVersion
    for name, value in tags.items():
        tag, field = of[name]
        fields[tag] = field(value)
    return fields
