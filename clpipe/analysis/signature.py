"""The noise of a finished picture, and the flat areas in which it is measured.

A picture is compared with its ground truth, or with the mean of many pictures of the same scene.
Values are 8-bit levels, 0 to 255. :mod:`clpipe.analysis.matching.columns` computes statistics.
"""

import numpy as np
from numpy.typing import NDArray

from clpipe.base.types import Doubles, Mask
from clpipe.reference.colour import luma

DRIFT = 12.0  # px; smoother differences are changes of light or focus, not noise
SMOOTH = 3.0  # px; the picture is blurred by this sigma to find flat areas
FLAT = 60  # percentile of the gradient below which an area is flat
BIN = 8  # levels per bin of intensity
MIN_SAMPLES = 200  # samples that a bin needs
DARKEST, BRIGHTEST = 30, 225  # luma of the darkest and brightest pixels that are measured
DARK = 8  # luma of the darkest pixels in which noise is compared by intensity


def flat_mask(mean: NDArray[np.number], darkest: float = DARKEST) -> Mask:
    """Return the pixels of a picture without noise that are flat, and not dark or bright.

    In flat pixels the gradient of smoothed luma is below its 60th percentile. They are at least two
    pixels away from others. The result is a mask, (height, width).

    Args:
        mean: the picture, (height, width, 3), 0 to 255.
        darkest: the smallest valid luma.
    """
    from scipy import ndimage

    y = luma(mean)
    smooth = ndimage.gaussian_filter(y, SMOOTH)
    gradient = np.hypot(ndimage.sobel(smooth, 0), ndimage.sobel(smooth, 1))
    flat = ndimage.binary_erosion(gradient <= np.percentile(gradient, FLAT), np.ones((5, 5)))
    return np.asarray(flat & (y >= darkest) & (y <= BRIGHTEST))


def noise_of(picture: NDArray[np.number], mean: NDArray[np.number]) -> Doubles:
    """Return the noise of a picture, (height, width, 3): its difference from the mean, minus drift.

    Drift is the difference blurred with a Gaussian of 12 px. It is removed in the cosine transform,
    which mirrors the picture at its edges, and needs a fifth of the time.

    Args:
        picture: (height, width, 3), 0 to 255, in floats of the result's precision.
        mean: the same scene without noise.
    """
    from scipy import fft

    noise = np.subtract(picture, mean, dtype=np.result_type(picture, mean, np.float32))
    down, right = (
        np.exp(-0.5 * (DRIFT * np.pi * np.arange(size) / size) ** 2) for size in noise.shape[:2]
    )
    kept = (1 - np.outer(down, right)).astype(noise.dtype)
    return np.asarray(fft.idctn(fft.dctn(noise, axes=(0, 1)) * kept[..., None], axes=(0, 1)))
