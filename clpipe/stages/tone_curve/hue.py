"""Tone curves that keep hues, the twin of kernels/lib/hue.h."""

from collections.abc import Callable

import numpy as np

from clpipe.base.types import Floats

Pair = tuple[Floats, Floats]


def extremes_of(image: Floats) -> tuple[Floats, Floats, Floats]:
    """The colours, (height, width, 3), clipped to 0..1; the smallest and the largest of the three.

    >>> [each.tolist() for each in extremes_of(np.float32([[[-0.25, 0.5, 2]]]))[1:]]
    [[[[0.0]]], [[[1.0]]]]
    """
    inside = np.clip(np.nan_to_num(image), np.float32(0), np.float32(1))
    return inside, inside.min(-1, keepdims=True), inside.max(-1, keepdims=True)


def between_extremes(inside: Floats, before: Pair, after: Pair) -> Floats:
    """Move the smallest and the largest of three colours; the third keeps its relative place.

    Args:
        inside: (height, width, 3), clipped to 0..1.
        before: the smallest and the largest, (height, width, 1).
        after: what they become.
    """
    (low, high), (to_low, to_high) = before, after
    slope = (to_high - to_low) / np.maximum(high - low, np.float32(1e-6))
    return to_low + (inside - low) * slope


def keep_hue(image: Floats, curve: Callable[[Floats], Floats]) -> Floats:
    """A curve on the largest and smallest of the three colours; the third keeps its relative place.

    So Adobe's DNG software applies its tone curves. Hue in HSV stays, and on each channel alone it
    would not: orange would become yellow.

    Args:
        image: (height, width, 3), clipped to 0..1.
        curve: on an array of values 0..1.

    >>> keep_hue(np.float32([[[0.25, 0.5, 1]]]), np.sqrt).round(3).tolist()
    [[[0.5, 0.6669999957084656, 1.0]]]
    """
    inside, low, high = extremes_of(image)
    return between_extremes(inside, (low, high), (curve(low), curve(high)))
