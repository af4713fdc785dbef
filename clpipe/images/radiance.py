"""Reads the text header of Radiance pictures (.hdr), and converts their samples to light.

Sources: G. Ward, "Real Pixels", Graphics Gems II (1991), and the description of file formats in the
Radiance distribution.
"""

import re
from dataclasses import dataclass

import numpy as np

from clpipe.base.errors import ImageError
from clpipe.base.types import Floats
from clpipe.images.colour import CIE_XYZ

MAGIC = b"#?"
HEADER_BYTES = 1 << 16
SIZE = re.compile(rb"([+-][XY]) +\d+ +([+-][XY]) +\d+ *\r?$")

# EXIF's orientation, by the directions of rows and of samples in a row.
ORIENTATIONS = {
    **{b"-Y+X": 1, b"-Y-X": 2, b"+Y-X": 3, b"+Y+X": 4},
    **{b"+X-Y": 5, b"-X-Y": 6, b"-X+Y": 7, b"+X+Y": 8},
}


@dataclass(frozen=True)
class RadianceHeader:
    """The header of a Radiance picture.

    Args:
        factors: the factors of red, green and blue: the products of all EXPOSURE and COLORCORR
            lines.
        chromaticities: x and y of red, green, blue and white; None if they are not stated.
        pixel_aspect: height of a pixel over its width.
        is_standard: whether OpenImageIO reads the file correctly.
        orientation: EXIF's orientation of the stored samples.
        size: the line with the picture's size.
        end: the offset in the file at which the samples begin.
    """

    factors: tuple[float, float, float]
    chromaticities: tuple[float, ...] | None
    pixel_aspect: float
    is_standard: bool
    orientation: int
    size: bytes
    end: int

    @property
    def standard(self) -> bytes:
        """A header for the same samples that OpenImageIO reads correctly."""
        return b"#?RADIANCE\nFORMAT=32-bit_rle_rgbe\n\n" + self.size + b"\n"


def radiance_header(start: bytes) -> RadianceHeader:
    r"""Return the header at the start of a file.

    >>> start = b"#?RADIANCE\nEXPOSURE=2\nEXPOSURE=4\nFORMAT=32-bit_rle_rgbe\n\n-Y 6 +X 8\n"
    >>> radiance_header(start).factors
    (8.0, 8.0, 8.0)

    Raises:
        ImageError: it is cut off, or a line in it is wrong; the message does not contain the file.
    """
    factors, aspect = np.ones(3), 1.0
    chromaticities: tuple[float, ...] | None = None
    format_, offset = b"", 0
    while True:
        line, newline, _ = start[offset:].partition(b"\n")
        offset += len(line) + 1
        if not newline:
            raise ImageError("it is damaged: its header has no end")
        if not line.strip():
            break
        name, _, value = line.partition(b"=")
        name = name.strip().upper()
        if name == b"EXPOSURE":
            factors *= _numbers(line, value, 1)
        elif name == b"COLORCORR":
            factors *= _numbers(line, value, 3)
        elif name == b"PIXASPECT":
            aspect *= _numbers(line, value, 1)[0]
        elif name == b"PRIMARIES":
            chromaticities = tuple(_numbers(line, value, 8, positive=False).tolist())
        elif name == b"FORMAT":
            format_ = value.strip()
    if format_ not in (b"", b"32-bit_rle_rgbe", b"32-bit_rle_xyze"):
        raise ImageError(
            f"its FORMAT is {format_.decode(errors='replace')!r}, but must be 32-bit_rle_rgbe or "
            "32-bit_rle_xyze"
        )
    size, newline, _ = start[offset:].partition(b"\n")
    found = SIZE.match(size)
    orientation = ORIENTATIONS.get(found[1] + found[2]) if found else None
    if not newline or orientation is None:
        raise ImageError("it is damaged: its header states no size, such as -Y 480 +X 640")
    red, green, blue = factors.tolist()
    is_xyz = format_ == b"32-bit_rle_xyze"
    is_standard = format_ == b"32-bit_rle_rgbe" and b"\r" not in start[: offset + len(size)]
    return RadianceHeader(
        (red, green, blue),
        CIE_XYZ if is_xyz else chromaticities,
        aspect,
        is_standard,
        orientation,
        size.strip(),
        offset + len(size) + 1,
    )


def _numbers(line: bytes, text: bytes, count: int, positive: bool = True) -> Floats:
    """Return the numbers of a header's line.

    Raises:
        ImageError: their number is not ``count``, or one is not finite, or is not positive although
            ``positive`` is set.
    """
    try:
        numbers = np.array([float(each) for each in text.split()])
    except ValueError:
        numbers = np.empty(0)
    if len(numbers) != count or not np.isfinite(numbers).all() or (positive and min(numbers) <= 0):
        kind = "positive number" if positive else "number"
        raise ImageError(
            f"its header has the line {line[:80].decode(errors='replace')!r}; expected {count} "
            f"{kind}{'s' * (count > 1)}"
        )
    return numbers


def to_light(samples: Floats, header: RadianceHeader) -> Floats:
    """Return linear light, (height, width, 3), from samples of mantissa times a power of two.

    Writers truncate mantissas, so Radiance interprets each as the middle of its step.
    """
    largest = samples.max(axis=-1, keepdims=True)
    _, exponent = np.frexp(largest)
    half: Floats = np.where(largest > 0, np.ldexp(np.float32(1), exponent - 9), np.float32(0))
    factors: Floats = np.array(header.factors, np.float32)
    return (samples + half) / factors
