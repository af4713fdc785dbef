"""Arrays of pixels as files hold them: sizes, data windows, and values that are not finite."""

from pathlib import Path

import numpy as np

from clpipe.base.errors import ImageError
from clpipe.base.types import Array

MAX_PIXELS = 1_000_000_000  # the largest --max-pixels
USUAL_MAX_PIXELS = 200_000_000  # its default: what a file may claim
HALF_MAX = np.float32(65504)  # the largest half


def check_size(path: Path, width: int, height: int, max_pixels: int) -> None:
    """See that an image has pixels, and not more than are read; call it before memory is taken.

    Raises:
        ImageError: it has none, or more.
    """
    if width < 1 or height < 1 or width * height > max_pixels:
        raise ImageError(
            f"{path}: {width}x{height} pixels; at most {max_pixels} are read (--max-pixels)"
        )


def display_window(data: Array, x: int, y: int, width: int, height: int) -> Array:
    """The display window of an image, (height, width, channel), black outside its data window.

    ``data`` is the data window, (rows, columns, channel); its upper left pixel is at column ``x``
    and row ``y`` of the display window.
    """
    window = np.zeros((height, width, data.shape[2]), data.dtype)
    left, top = max(x, 0), max(y, 0)
    right, bottom = min(x + data.shape[1], width), min(y + data.shape[0], height)
    if left < right and top < bottom:
        window[top:bottom, left:right] = data[top - y : bottom - y, left - x : right - x]
    return window


def without_non_finite(pixels: Array) -> tuple[Array, int]:
    """The image with 0 in place of each NaN and infinity, and their number."""
    if pixels.dtype == np.float16:
        bits = pixels.view(np.uint16)
        if bits.max() < 0x7C00:  # all are finite, and none is negative
            return pixels, 0
        bad = (bits & 0x7C00) == 0x7C00
    else:
        bad = ~np.isfinite(pixels)
    count = int(np.count_nonzero(bad))
    if count:
        pixels = np.where(bad, pixels.dtype.type(0), pixels)
    return pixels, count
