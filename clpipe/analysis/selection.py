"""TODO."""

import numpy as np

from clpipe.analysis.statistics import Doubles, Mask, bin_of
from clpipe.base.types import Floats

CLIPPED = 1e-3  # share of a bin's samples from which clipping bends its statistics
WINDOW = 5  # pixels, in which a flat place has to be flat
FLATTEST = 0.25  # share of a picture that counts as flat whatever its noise
MAD_TO_SIGMA = 1.4826  # of a normal distribution


def unclipped(intensity: Floats, clipped: Mask, edges: Doubles, start: Mask) -> Mask:
    """The pixels of ``start`` at intensities where clipping does not bend the noise.

    Leaving out clipped samples alone would leave a lopsided rest. So all pixels of an intensity bin
    go where more than :data:`CLIPPED` of its samples are clipped, and from the others those that
    are clipped in any frame.

    Args:
        intensity: (height, width).
        clipped: (frame, height, width), True where a sample is clipped.
        edges: of the intensity bins.
        start: (height, width), the pixels to choose from.
    """
    index = bin_of(intensity, edges)
    size = len(edges) - 1
    count = np.bincount(index[start], minlength=size)
    lost = np.bincount(index[start], clipped.mean(0)[start], minlength=size)
    whole = lost <= CLIPPED * count
    return start & whole[index] & ~clipped.any(0)


def flat(truth: Floats, noise: Floats, mask: Mask) -> Mask:
    """The pixels of a picture around which its truth hardly changes.

    At edges, misplaced pixels, demosaicing and JPEG make differences that are no noise. A pixel is
    flat where the truth, averaged 5x5, spans no more in the 5x5 window around it than the sigma of
    the noise, in any channel. The flattest quarter of the picture counts whatever its noise, and
    gives that sigma (1.4826 times the median absolute deviation).

    Args:
        truth: (height, width, channel).
        noise: (frame, height, width, channel).
        mask: (height, width), the pixels to choose from; at least one.
    """
    smooth = _slide(np.add, truth) / np.float32(WINDOW**2)
    span = (_slide(np.maximum, smooth) - _slide(np.minimum, smooth)).max(-1)
    quarter = np.quantile(span[mask], FLATTEST)
    samples = noise[:, mask & (span <= quarter)]
    sigma = MAD_TO_SIGMA * float(np.median(np.abs(samples - np.median(samples))))
    return mask & (span <= max(float(quarter), sigma))


def _slide(function: np.ufunc, image: Floats) -> Floats:
    """A commutative function over the 5x5 window around each pixel, edges repeated."""
    for axis in (0, 1):
        size = image.shape[axis]
        places = np.arange(WINDOW)[:, None] + np.arange(size) - WINDOW // 2
        first, *rest = np.clip(places, 0, size - 1)
        result = image.take(first, axis)
        for place in rest:
            result = function(result, image.take(place, axis))
        image = result
    return image
