"""Arrays of pixels from files: sizes, data windows, and values that are not finite."""

from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from clpipe.base.cpu_time import CpuTimer
from clpipe.base.errors import ImageError
from clpipe.base.memory import release_pages
from clpipe.base.types import Array, Floats
from clpipe.reference.geometry import NO_MARGINS, Margins

MAX_PIXELS = 1_000_000_000  # the largest --max-pixels
DEFAULT_MAX_PIXELS = 200_000_000  # the default of --max-pixels
HALF_MAX = np.float32(65504)  # the largest half
BLOCK = 1 << 18  # samples that fit into a cache


def check_size(path: Path, width: int, height: int, max_pixels: int) -> None:
    """Check that an image has pixels, but not too many. Call it before allocating memory.

    Raises:
        ImageError: it has no pixels, or more than ``max_pixels``.
    """
    if width < 1 or height < 1:
        raise ImageError(f"{path}: damaged: its header states {width}x{height} pixels")
    if width * height > max_pixels:
        raise ImageError(
            f"{path}: this file has {width}x{height} pixels; at most {max_pixels} are read. To "
            "read more, set --max-pixels"
        )


def overscan_margins(x: int, y: int, data: Sequence[int], display: Sequence[int]) -> Margins:
    """Return the overscan: how far the data window exceeds the display window on each side.

    It is 0 if the windows do not overlap.

    Args:
        x: the column of the data window's upper left pixel in the display window.
        y: the row of this pixel.
        data: the width and height of the data window in px.
        display: the width and height of the display window in px.

    >>> tuple(overscan_margins(-2, 1, (10, 6), (7, 7)))
    (2, 0, 1, 0)
    >>> tuple(overscan_margins(7, 0, (3, 3), (7, 7)))
    (0, 0, 0, 0)
    """
    (width, height), (right, bottom) = display, (x + data[0], y + data[1])
    if not windows_overlap(x, y, data, display):
        return NO_MARGINS
    return Margins(*(max(each, 0) for each in (-x, -y, right - width, bottom - height)))


def windows_overlap(x: int, y: int, data: Sequence[int], display: Sequence[int]) -> bool:
    """Return whether a data window has pixels in the display window; for the arguments, see above.

    >>> windows_overlap(7, 0, (3, 3), (7, 7)), windows_overlap(6, 0, (3, 3), (7, 7))
    (False, True)
    """
    return min(x + data[0], y + data[1]) > 0 and x < display[0] and y < display[1]


@CpuTimer("convert")
def display_window(
    data: Array, x: int, y: int, width: int, height: int, outside: float = 0
) -> Array:
    """Return the display window of an image, (height, width, channel).

    Args:
        data: the data window, (rows, columns, channel).
        x: the column of its upper left pixel in the display window.
        y: the row of this pixel.
        width: the width of the display window in px.
        height: its height in px.
        outside: the value of pixels outside the data window.
    """
    window = np.full((height, width, data.shape[2]), outside, data.dtype)
    left, top = max(x, 0), max(y, 0)
    right, bottom = min(x + data.shape[1], width), min(y + data.shape[0], height)
    if left < right and top < bottom:
        window[top:bottom, left:right] = data[top - y : bottom - y, left - x : right - x]
    return window


@CpuTimer("convert")
def convert_by_rows(convert: Callable[[Array], Array], pixels: Array) -> Floats:
    """Return a new float32 image, converted a few rows at a time.

    Intermediate results therefore never need the memory of whole images.
    """
    result = np.empty(pixels.shape, np.float32)
    rows = max(BLOCK // max(pixels[0].size, 1), 1)
    for top in range(0, len(pixels), rows):
        result[top : top + rows] = convert(pixels[top : top + rows])
    return result


@CpuTimer("convert")
def make_finite(pixels: Array) -> tuple[int, int]:
    """Replace each NaN and infinity of an image, in place, and return the numbers of both kinds.

    Infinite light is a light that overflowed, such as the sun in half floats. It becomes the
    largest half. NaN and negative infinity become 0.
    """
    infinity = np.array(np.inf, pixels.dtype)
    bright = dark = 0
    for block in _blocks_outside(pixels, np.nextafter(infinity, pixels.dtype.type(0))):
        bad, endless = ~np.isfinite(block), np.isposinf(block)
        bright += int(np.count_nonzero(endless))
        dark += int(np.count_nonzero(bad)) - int(np.count_nonzero(endless))
        block[bad] = 0
        block[endless] = HALF_MAX
    return bright, dark


@CpuTimer("convert")
def clip_to_half(pixels: Array) -> int:
    """Clip float32 samples to the range of half, in place, and return the number clipped."""
    count = 0
    for block in _blocks_outside(pixels, HALF_MAX):
        count += int(np.count_nonzero(np.abs(block) > HALF_MAX))
        np.clip(block, -HALF_MAX, HALF_MAX, out=block)
    return count


def _blocks_outside(pixels: Array, limit: Any) -> Iterator[Array]:
    """Yield views of the blocks of an image that have samples outside -limit..limit.

    The image may be planar in memory. Bits compare faster than floats. The bits of non-negative
    floats have the order of the floats, with NaN last.
    """
    whole = np.dtype(f"u{pixels.dtype.itemsize}")
    largest, without_sign = limit.view(whole), np.iinfo(whole).max >> 1
    samples = pixels.ravel("K")
    for start in range(0, samples.size, BLOCK):
        block = samples[start : start + BLOCK]
        bits = block.view(whole)
        if bits.max() > largest and (bits & without_sign).max() > largest:
            yield block
        if type(pixels) is np.memmap:
            release_pages(pixels)
