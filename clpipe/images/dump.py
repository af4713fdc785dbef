"""Headerless dumps of a sensor: samples of one mosaic, row by row, and nothing else."""

import math
import re
from dataclasses import dataclass
from fractions import Fraction
from pathlib import Path

import numpy as np

from clpipe.base.errors import ImageError, RequestError
from clpipe.base.types import Array, Floats

# Bytes a sample. RAW10 and RAW12 are packed as MIPI CSI-2 sends them, without padding of rows.
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
    """The geometry of a dump: its size in pixels, and how samples are stored."""

    width: int
    height: int
    type: str

    @property
    def byte_count(self) -> int:
        """How many bytes it has."""
        return int(self.width * self.height * TYPES[self.type])

    def unpack(self, data: bytes) -> Floats:
        """The mosaic in DN, (height, width).

        >>> Dump(4, 1, "raw10").unpack(bytes([0x80, 0, 0, 0xFF, 0b11_00_00_01])).tolist()
        [[513.0, 0.0, 0.0, 1023.0]]
        >>> Dump(2, 1, "raw12").unpack(bytes([0x12, 0xAB, 0xC3])).tolist()
        [[291.0, 2748.0]]

        Raises:
            ImageError: it has not that many bytes.
        """
        if len(data) != self.byte_count:
            raise ImageError(
                f"{len(data)} bytes, but {self.width}x{self.height} {self.type} has "
                f"{self.byte_count}; {fitting(len(data), self)}"
            )
        if self.type in ("uint16le", "uint16be"):
            samples: Array = np.frombuffer(data, "<u2" if self.type == "uint16le" else ">u2")
        else:
            samples = np.frombuffer(data, np.uint8)
            if self.type == "raw10":
                samples = _unpacked(samples, 4, 2)
            elif self.type == "raw12":
                samples = _unpacked(samples, 2, 4)
        return samples.astype(np.float32).reshape(self.height, self.width)


def dump_of(size: str, type_: str) -> Dump:
    """The geometry that ``raw_size`` and ``raw_type`` give.

    >>> dump_of("768x512", "uint16le").byte_count
    786432

    Raises:
        RequestError: one is missing or not allowed.
    """
    if type_ not in TYPES:
        raise RequestError(f"raw_type: found {type_!r}; expected one of {', '.join(TYPES)}")
    match = re.fullmatch(r"(\d{1,5})x(\d{1,5})", size)
    width, height = (int(match[1]), int(match[2])) if match else (0, 0)
    if not (2 <= width <= MAX_SIDE and 2 <= height <= MAX_SIDE):
        raise RequestError(
            f"raw_size: found {size!r}; expected WIDTHxHEIGHT in pixels, such as 1920x1080, "
            f"each 2 to {MAX_SIDE}"
        )
    together = TYPES[type_].denominator
    if width % together:
        raise RequestError(
            f"raw_size: found {size!r}; a row of {type_} has a multiple of {together} pixels"
        )
    return Dump(width, height, type_)


def read_dump(data: bytes, path: Path, dump: Dump) -> Floats:
    """The mosaic of a dump in DN, (height, width).

    Raises:
        ImageError: it has another size; the message says what would fit.
    """
    try:
        return dump.unpack(data)
    except ImageError as error:
        raise ImageError(f"{path}: {error}") from None


def _unpacked(data: Array, count: int, low: int) -> Array:
    """Groups of ``count`` samples: their upper eight bits each, then a byte of ``low`` lower bits
    each, the first sample's lowest (MIPI Alliance, CSI-2, RAW10 and RAW12).
    """
    groups = data.reshape(-1, count + 1).astype(np.uint16)
    shifts = np.arange(count, dtype=np.uint16) * low
    rest = (groups[:, count:] >> shifts) & ((1 << low) - 1)
    return (groups[:, :count] << low) | rest


def fitting(count: int, asked: Dump) -> str:
    """What types of the size asked for, and what sizes of the type, have so many bytes.

    >>> fitting(24, Dump(6, 4, "uint16le"))
    'it would fit 6x4 uint8, 3x4 uint16le, 4x3 uint16le, 6x2 uint16le, 2x6 uint16le'
    """
    same = [name for name, size in TYPES.items() if asked.width * asked.height * size == count]
    found = [f"{asked.width}x{asked.height} {name}" for name in same]
    found += [f"{w}x{h} {asked.type}" for w, h in sizes_of(count, asked)[:5]]
    return f"it would fit {', '.join(found)}" if found else f"no size of {asked.type} fits"


def sizes_of(count: int, asked: Dump) -> list[tuple[int, int]]:
    """Widths and heights of so many bytes, those that are most like what was asked for first."""
    samples = count / TYPES[asked.type]
    if samples.denominator != 1:
        return []
    total, together = samples.numerator, TYPES[asked.type].denominator
    widths = range(max(2, together), min(total // 2, MAX_SIDE) + 1, together)
    pairs = [(w, total // w) for w in widths if total % w == 0 and total // w <= MAX_SIDE]

    def unlike(pair: tuple[int, int]) -> float:
        ratios = pair[0] / asked.width, pair[1] / asked.height
        return round(sum(abs(math.log(r)) for r in ratios), 6)

    return sorted(pairs, key=unlike)
