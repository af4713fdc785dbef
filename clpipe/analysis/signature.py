"""The noise of a finished picture, and the flat places where it is measured.

A picture is compared with its truth, or with the mean of many pictures of the same scene. Values
are eight-bit levels, 0 to 255. :mod:`clpipe.analysis.matching.columns` has the figures.
"""

import numpy as np
from numpy.typing import NDArray

from clpipe.base.types import Doubles, Mask

DRIFT = 12.0  # px; what is smoother than this is no noise but light or focus that changed
SMOOTH = 3.0  # px, of the picture in which flat places are looked for
FLAT = 60  # percentile of the gradient
BIN = 8  # levels; the noise of a bin is compared with that bin's sigma
FEWEST = 200  # samples of a bin
DARKEST, BRIGHTEST = 30, 225  # luma

LUMA = np.array([0.299, 0.587, 0.114])  # BT.601


def luma(pixels: NDArray[np.number]) -> Doubles:
    """BT.601 luma of (..., 3) levels."""
    return np.asarray(pixels @ LUMA, np.float64)


def chroma(noise: Doubles, of_luma: Doubles) -> tuple[Doubles, Doubles]:
    """Cb and Cr of (height, width, 3) noise whose luma is ``of_luma``."""
    return 0.564 * (noise[..., 2] - of_luma), 0.713 * (noise[..., 0] - of_luma)


def flat_places(mean: NDArray[np.number], darkest: float = DARKEST) -> Mask:
    """Where a picture without noise is flat and neither dark nor bright, (height, width).

    Flat is below the 60th percentile of the gradient of the smoothed luma, and two pixels away from
    what is not.

    Args:
        mean: (height, width, 3), 0 to 255.
        darkest: the least luma that counts.
    """
    from scipy import ndimage

    y = luma(mean)
    smooth = ndimage.gaussian_filter(y, SMOOTH)
    gradient = np.hypot(ndimage.sobel(smooth, 0), ndimage.sobel(smooth, 1))
    flat = ndimage.binary_erosion(gradient <= np.percentile(gradient, FLAT), np.ones((5, 5)))
    return np.asarray(flat & (y >= darkest) & (y <= BRIGHTEST))


def noise_of(picture: NDArray[np.number], mean: NDArray[np.number]) -> Doubles:
    """The noise of a picture, (height, width, 3): its difference from the mean without slow drift.

    Drift is the difference under a Gaussian of 12 px. It is taken out in the cosine transform,
    which continues the picture as its mirror image, and takes a fifth of the time.

    Args:
        picture: (height, width, 3), 0 to 255; in floats of the result's precision.
        mean: the same scene without noise.
    """
    from scipy import fft

    noise = np.subtract(picture, mean, dtype=np.result_type(picture, mean, np.float32))
    down, right = (
        np.exp(-0.5 * (DRIFT * np.pi * np.arange(size) / size) ** 2) for size in noise.shape[:2]
    )
    kept = (1 - np.outer(down, right)).astype(noise.dtype)
    return np.asarray(fft.idctn(fft.dctn(noise, axes=(0, 1)) * kept[..., None], axes=(0, 1)))
