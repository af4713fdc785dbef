"""Weighted means of surrounding pixels, for blur: the counterpart of ``kernels/convolve.cl``.

A point spread function is (height, width, 3) float64 of odd sides, centred. It describes how the
light of a pixel spreads over its neighbours, for red, green and blue, each with the sum 1. Taps
describe which pixels contribute to a pixel, so they are the mirror image.
"""

import numpy as np

from clpipe.base.pure import pure
from clpipe.base.types import Doubles, Floats
from clpipe.reference.image import tap

NEGLIGIBLE = 5e-4  # the smallest weights are omitted, up to this share of the light


def taps_of(psf: Doubles) -> Floats:
    """Return the taps of a point spread function: (tap, 5) float32, by rows.

    Each tap is dx and dy in px, and the weights of that pixel for red, green and blue, each with
    the sum 1 over all taps. The smallest weights are omitted, up to a total of :data:`NEGLIGIBLE`.

    >>> taps_of(np.float64([[0.5, 0, 0.5]])[..., None].repeat(3, 2)).tolist()
    [[-1.0, 0.0, 0.5, 0.5, 0.5], [1.0, 0.0, 0.5, 0.5, 0.5]]
    """
    mirrored = psf[::-1, ::-1]
    largest = mirrored.max(2)
    ascending = np.argsort(largest, axis=None, kind="stable")
    light = np.cumsum(largest.ravel()[ascending])
    kept = np.ones(largest.size, bool)
    kept[ascending[light <= NEGLIGIBLE * light[-1]]] = False
    rows, columns = np.nonzero(kept.reshape(largest.shape))
    weights = mirrored[rows, columns]
    weights = weights / weights.sum(0)
    offsets = np.stack([columns - psf.shape[1] // 2, rows - psf.shape[0] // 2], 1)
    return np.ascontiguousarray(np.hstack([offsets, weights]), np.float32)


@pure
def tap_radius(taps: Floats) -> int:
    """Return the largest distance of a tap along a row or a column, in px."""
    return int(abs(taps[:, :2]).max())


def convolve(image: Floats, taps: Floats) -> Floats:
    """Return the weighted means; (height, width, 3) in and out, mirrored at the borders."""
    total: Floats = np.zeros((), np.float32)
    for dx, dy, *weights in taps:
        total = total + np.asarray(weights, np.float32) * tap(image, int(dx), int(dy))
    return total


def blur(image: Floats, weights: Floats) -> Floats:
    """Like :func:`convolve`, with the same weights along rows and columns.

    ``weights[k]`` is the weight of the pixels k to either side. Over both sides, their sum is 1.
    """
    rows = weights[0] * image
    for k, weight in enumerate(weights[1:], 1):
        rows = rows + weight * (tap(image, -k, 0) + tap(image, k, 0))
    total: Floats = np.zeros((), np.float32)
    for dy in range(1 - len(weights), len(weights)):
        total = total + weights[abs(dy)] * tap(rows, 0, dy)
    return total
