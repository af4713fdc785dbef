"""Selects where a picture's noise is measured: flat areas, everywhere, or after averaging 2x2.

The constants are arbitrary choices. tests/test_statistics.py shows what they select.
"""

import numpy as np

from clpipe.base.types import Doubles, Floats, Mask
from clpipe.reference.image import in_blocks

PICTURE, FLAT, HALVED = PLACES = ("picture", "flat", "halved")

WINDOW = 5  # px: side of the window that decides whether a pixel is flat
FLATTEST = 0.25  # share of a picture that always counts as flat
MAD_TO_SIGMA = 1.4826  # sigma of a normal distribution, relative to its median absolute deviation


def covariance(noise: Floats) -> Doubles:
    """Return the covariance of the channels' noise over all frames, (channel, channel).

    Args:
        noise: (frame, height, width, channel).

    >>> covariance(np.float32([1, 2, -1, -2]).reshape(1, 1, 2, 2)).tolist()
    [[1.0, 2.0], [2.0, 4.0]]
    """
    channels = noise.shape[-1]
    products, total = np.zeros((channels, channels)), np.zeros(channels)
    for frame in noise:  # one at a time, because all frames in float64 take too much memory
        samples = frame.reshape(-1, channels).astype(np.float64)
        products += samples.T @ samples
        total += samples.sum(0)
    count = noise.size // channels
    mean = total / count
    return np.asarray(products / count - np.outer(mean, mean))


def halved(noise: Floats) -> Floats:
    """Return noise, (frame, height, width, channel), averaged over 2x2 pixels.

    An odd last row or column is dropped.
    """
    return np.asarray(in_blocks(noise, 2, axis=1).mean((2, 4)), np.float32)


def select_flat(truth: Floats, noise: Floats, mask: Mask) -> Mask:
    """Return the pixels of ``mask`` around which the ground truth is nearly constant.

    At edges, shifts of pixels, demosaicing and JPEG cause differences that are not noise. First,
    the ground truth is averaged over 5x5 pixels. A pixel is flat if the range of that average in
    the 5x5 window around it is at most the sigma of the noise, in every channel. The flattest
    quarter of the picture always counts. Sigma is measured there, as 1.4826 times the median
    absolute deviation.

    Args:
        truth: ground truth, (height, width, channel).
        noise: (frame, height, width, channel).
        mask: the pixels to select from, (height, width); at least one is set.
    """
    smooth = _over_window(np.add, truth) / np.float32(WINDOW**2)
    local_range = (_over_window(np.maximum, smooth) - _over_window(np.minimum, smooth)).max(-1)
    quarter = np.quantile(local_range[mask], FLATTEST)
    samples = noise[:, mask & (local_range <= quarter)]
    sigma = MAD_TO_SIGMA * float(np.median(np.abs(samples - np.median(samples))))
    return mask & (local_range <= max(float(quarter), sigma))


def _over_window(function: np.ufunc, image: Floats) -> Floats:
    """Reduce the 5x5 window around each pixel with a commutative function; edges are repeated."""
    for axis in (0, 1):
        size = image.shape[axis]
        offsets = np.arange(WINDOW)[:, None] + np.arange(size) - WINDOW // 2
        first, *rest = np.clip(offsets, 0, size - 1)
        result = image.take(first, axis)
        for offset in rest:
            result = function(result, image.take(offset, axis))
        image = result
    return image
