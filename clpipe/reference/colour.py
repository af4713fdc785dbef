"""Luma and colour differences, like in ``kernels/lib/colour.h``."""

from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from clpipe.base.types import Array, Floats

Float = TypeVar("Float", bound=np.floating[Any])

LUMA = np.array([0.299, 0.587, 0.114], np.float32)


def luma(image: Array) -> Array:
    """Return the luma of ITU-R BT.601 of (..., 3) RGB: Y = 0.299R + 0.587G + 0.114B.

    Floats keep their precision; whole numbers become float32.
    """
    red, green, blue = np.moveaxis(image, -1, 0)
    return np.asarray(LUMA[0] * red + LUMA[1] * green + LUMA[2] * blue)


def rgb_to_ycbcr(image: NDArray[Float]) -> NDArray[Float]:
    """Apply ITU-R BT.601: :func:`luma` Y, Cb = 0.564(B-Y), Cr = 0.713(R-Y).

    ``image`` is (..., 3) RGB, in floats. The result has the same shape and precision.
    """
    red, _, blue = np.moveaxis(image, -1, 0)
    y = luma(image)
    return np.stack([y, np.float32(0.564) * (blue - y), np.float32(0.713) * (red - y)], axis=-1)


def ycbcr_to_rgb(image: Floats) -> Floats:
    """Invert :func:`rgb_to_ycbcr`, exactly except for rounding.

    >>> ycbcr_to_rgb(rgb_to_ycbcr(np.float32([[[0.2, 0.5, 0.9]]]))).round(5).tolist()
    [[[0.20000000298023224, 0.5, 0.8999999761581421]]]
    """
    y, cb, cr = np.moveaxis(image, -1, 0)
    red = y + cr * np.float32(1.4025246)
    blue = y + cb * np.float32(1.7730496)
    green = (y - LUMA[0] * red - LUMA[2] * blue) * np.float32(1.7035775)
    return np.stack([red, green, blue], axis=-1)
