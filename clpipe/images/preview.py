"""Small pictures of images, for notebooks."""

import io

import numpy as np
from PIL import Image

from clpipe.base.types import Array
from clpipe.reference.curve import to_8_bit


def png_bytes(pixels: Array, side: int = 1024) -> bytes:
    """A PNG of an image, at most ``side`` pixels wide and high.

    Args:
        pixels: (height, width) or (height, width, 3), uint8, or floats that show 0 as black and 1
            as white.
        side: larger images keep every second, third, ... pixel.

    >>> png_bytes(np.zeros((2, 3), np.float32))[:4]
    b'\\x89PNG'
    """
    step = -(-max(pixels.shape[:2]) // side)
    small = np.ascontiguousarray(pixels[::step, ::step])
    picture = Image.fromarray(small if small.dtype == np.uint8 else to_8_bit(small))
    file = io.BytesIO()
    picture.save(file, "PNG")
    return file.getvalue()
