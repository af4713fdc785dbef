"""Arrays of pixels as files hold them: data windows, and values that are not finite."""

import numpy as np

from clpipe.base.types import Array

HALF_MAX = np.float32(65504)  # the largest half


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
