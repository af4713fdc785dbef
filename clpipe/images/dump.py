"""Headerless dumps of a sensor, which contain only the samples of one mosaic, row by row."""

import math
import re
from dataclasses import dataclass
from fractions import Fraction
from pathlib import Path

import numpy as np

from clpipe.base.errors import ImageError, RequestError
from clpipe.base.reading import check_regular
from clpipe.base.text import unknown_name
from clpipe.base.types import Array, Floats
from clpipe.images.pixels import DEFAULT_MAX_PIXELS, check_size

# Bytes of a sample. RAW10 and RAW12 are packed as in MIPI CSI-2, without padding after rows.
TYPES = {
    "uint8": Fraction(1),
    "uint16le": Fraction(2),
    "uint16be": Fraction(2),
    "raw10": Fraction(5, 4),
    "raw12": Fraction(3, 2),
}

MAX_SIDE = 65535


@dataclass(frozen=True)
class Dump:
    """The format of a dump: its width and height in px, and its sample type in :data:`TYPES`."""

    width: int
    height: int
    type: str

    @property
    def byte_count(self) -> int:
        """The size of the file in bytes."""
        return int(self.width * self.height * TYPES[self.type])

    def check_size(self, count: int) -> None:
        """Check that a file of ``count`` bytes can be such a dump.

        Raises:
            ImageError: it cannot; the message lists formats that fit.
        """
        if count != self.byte_count:
            raise ImageError(
                f"this file has {count} bytes, but {self.width}x{self.height} {self.type} has "
                f"{self.byte_count}; {fitting_formats(count, self)}"
            )

    def unpack(self, data: bytes) -> Floats:
        """Return the mosaic in DN, (height, width) float32.

        >>> Dump(4, 1, "raw10").unpack(bytes([0x80, 0, 0, 0xFF, 0b11_00_00_01])).tolist()
        [[513.0, 0.0, 0.0, 1023.0]]
        >>> Dump(2, 1, "raw12").unpack(bytes([0x12, 0xAB, 0xC3])).tolist()
        [[291.0, 2748.0]]

        Raises:
            ImageError: the data has another size; the message lists formats that fit.
        """
        self.check_size(len(data))
        if self.type in ("uint16le", "uint16be"):
            samples: Array = np.frombuffer(data, "<u2" if self.type == "uint16le" else ">u2")
        else:
            samples = np.frombuffer(data, np.uint8)
            if self.type == "raw10":
                samples = _unpack_mipi(samples, 4, 2)
            elif self.type == "raw12":
                samples = _unpack_mipi(samples, 2, 4)
        return samples.astype(np.float32).reshape(self.height, self.width)


def parse_dump(text: str) -> Dump:
    """Return the format that the setting ``dump`` describes.

    >>> parse_dump("768x512:uint16le").byte_count
    786432

    Raises:
        RequestError: the text has another form, or a value is not allowed.
    """
    match = re.fullmatch(r"(\d{1,5})x(\d{1,5}):(\w+)", text)
    if not match:
        raise RequestError(
            f"dump: found {text!r}; expected WIDTHxHEIGHT:TYPE, such as 1920x1080:uint16le"
        )
    width, height, type_ = int(match[1]), int(match[2]), match[3]
    if type_ not in TYPES:
        raise RequestError(f"dump: {unknown_name('type', type_, list(TYPES))}")
    if not (2 <= width <= MAX_SIDE and 2 <= height <= MAX_SIDE):
        raise RequestError(
            f"dump: found {text!r}; width and height must be from 2 to {MAX_SIDE} pixels"
        )
    group = TYPES[type_].denominator
    if width % group:
        raise RequestError(
            f"dump: found {text!r}; the width of {type_} must be a multiple of {group} pixels"
        )
    return Dump(width, height, type_)


def read_dump(path: Path, dump: Dump, max_pixels: int = DEFAULT_MAX_PIXELS) -> Floats:
    """Return the mosaic of a dump in DN, (height, width) float32.

    Raises:
        ImageError: the file cannot be read, is too large, or has another size; the message lists
            formats that fit.
    """
    check_size(path, dump.width, dump.height, max_pixels)
    try:
        dump.check_size(check_regular(path).st_size)
        return dump.unpack(path.read_bytes())
    except OSError as error:
        raise ImageError(f"{path}: cannot be read: {error.strerror}") from None
    except ImageError as error:
        raise ImageError(f"{path}: {error}") from None


def _unpack_mipi(data: Array, count: int, low: int) -> Array:
    """Return samples of 8 + ``low`` bits from packed groups of ``count`` (MIPI Alliance, CSI-2).

    A group holds the upper eight bits of each sample, then one byte with the ``low`` lower bits of
    each. Those of the first sample are the lowest in that byte.
    """
    groups = data.reshape(-1, count + 1).astype(np.uint16)
    shifts = np.arange(count, dtype=np.uint16) * low
    rest = (groups[:, count:] >> shifts) & ((1 << low) - 1)
    return (groups[:, :count] << low) | rest


def fitting_formats(count: int, dump: Dump) -> str:
    """Return a clause with the formats of ``count`` bytes that share the size or type of a dump.

    >>> fitting_formats(24, Dump(6, 4, "uint16le"))
    'it would fit 6x4 uint8, 3x4 uint16le, 4x3 uint16le, 6x2 uint16le, 2x6 uint16le'
    """
    types = [name for name, size in TYPES.items() if dump.width * dump.height * size == count]
    formats = [f"{dump.width}x{dump.height} {name}" for name in types]
    formats += [f"{w}x{h} {dump.type}" for w, h in fitting_sizes(count, dump)[:5]]
    return f"it would fit {', '.join(formats)}" if formats else f"no size of {dump.type} fits"


def fitting_sizes(count: int, dump: Dump) -> list[tuple[int, int]]:
    """Return widths and heights with ``count`` bytes in a dump's type, most similar sizes first."""
    samples = count / TYPES[dump.type]
    if samples.denominator != 1:
        return []
    total, group = samples.numerator, TYPES[dump.type].denominator
    widths = range(max(2, group), min(total // 2, MAX_SIDE) + 1, group)
    pairs = [(w, total // w) for w in widths if total % w == 0 and total // w <= MAX_SIDE]

    def difference(pair: tuple[int, int]) -> float:
        ratios = pair[0] / dump.width, pair[1] / dump.height
        return round(sum(abs(math.log(r)) for r in ratios), 6)

    return sorted(pairs, key=difference)
