"""Selection: the pixels whose noise can be measured, neither clipped nor at edges.

The constants are choices; tests/test_statistics.py shows what they select.
"""

import numpy as np

from clpipe.analysis.intensity import bin_of
from clpipe.base.types import Doubles, Floats, Mask

CLIPPED = 1e-3  # share of a bin's samples from which clipping distorts its statistics
WINDOW = 5  # px, in which a flat place has to be flat
FLATTEST = 0.25  # share of a picture that counts as flat whatever its noise
MAD_TO_SIGMA = 1.4826  # of a normal distribution


def select_unclipped(intensity: Floats, clipped: Mask, edges: Doubles, start: Mask) -> Mask:
    """The pixels of ``start`` at intensities where clipping does not distort the noise.

    Leaving out the clipped samples alone would leave a one-sided distribution. So an intensity bin
    is left out where more than :data:`CLIPPED` of its samples are clipped; in the other bins, each
    pixel that is clipped in any frame is left out.

    Args:
        intensity: (height, width).
        clipped: (frame, height, width), True where a sample is clipped.
        edges: of the intensity bins.
        start: (height, width), the pixels to select from.
    """
    index = bin_of(intensity, edges)
    size = len(edges) - 1
    count = np.bincount(index[start], minlength=size)
    lost = np.bincount(index[start], clipped.mean(0)[start], minlength=size)
    whole = lost <= CLIPPED * count
    return start & whole[index] & ~clipped.any(0)


def select_flat(truth: Floats, noise: Floats, mask: Mask) -> Mask:
    """The pixels of ``mask`` around which the truth hardly changes.

    At edges, shifts of pixels, demosaicing and JPEG make differences that are not noise. A pixel is
    flat where the truth, averaged over 5x5 pixels, spans no more in the 5x5 window around it than
    the sigma of the noise, in every channel. The flattest quarter of the picture always counts; the
    sigma is measured there, as 1.4826 times the median absolute deviation.

    Args:
        truth: (height, width, channel).
        noise: (frame, height, width, channel).
        mask: (height, width), the pixels to select from; at least one.
    """
    smooth = _over_window(np.add, truth) / np.float32(WINDOW**2)
    span = (_over_window(np.maximum, smooth) - _over_window(np.minimum, smooth)).max(-1)
    quarter = np.quantile(span[mask], FLATTEST)
    samples = noise[:, mask & (span <= quarter)]
    sigma = MAD_TO_SIGMA * float(np.median(np.abs(samples - np.median(samples))))
    return mask & (span <= max(float(quarter), sigma))


def _over_window(function: np.ufunc, image: Floats) -> Floats:
    """A commutative function over the 5x5 window around each pixel; edge pixels are repeated."""
    for axis in (0, 1):
        size = image.shape[axis]
        places = np.arange(WINDOW)[:, None] + np.arange(size) - WINDOW // 2
        first, *rest = np.clip(places, 0, size - 1)
        result = image.take(first, axis)
        for place in rest:
            result = function(result, image.take(place, axis))
        image = result
    return image
