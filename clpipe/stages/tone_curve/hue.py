"""Tone curves that keep hues, the counterpart of kernels/lib/hue.h."""

from collections.abc import Callable

import numpy as np

from clpipe.base.types import Floats


def clip_to_unit(image: Floats) -> Floats:
    """Return an image clipped to 0..1, of any shape; NaN becomes 0.

    >>> clip_to_unit(np.float32([-0.25, np.nan, 0.5, 2])).tolist()
    [0.0, 0.0, 0.5, 1.0]
    """
    return np.asarray(np.clip(np.nan_to_num(image), np.float32(0), np.float32(1)))


def keep_hue(image: Floats, curve: Callable[[Floats], Floats]) -> Floats:
    """Apply a curve to the largest and smallest colour; the third keeps its relative position.

    Adobe's DNG software applies its tone curves in this way. Hue in HSV does not change. A curve on
    each channel alone would turn orange into yellow.

    Args:
        image: (height, width, 3), clipped to 0..1.
        curve: a function of an array of values 0..1.

    >>> keep_hue(np.float32([[[0.25, 0.5, 1]]]), np.sqrt).round(3).tolist()
    [[[0.5, 0.6669999957084656, 1.0]]]
    """
    inside = clip_to_unit(image)
    low, high = inside.min(-1, keepdims=True), inside.max(-1, keepdims=True)
    to_low, to_high = curve(low), curve(high)
    slope = (to_high - to_low) / np.maximum(high - low, np.float32(1e-6))
    return to_low + (inside - low) * slope
