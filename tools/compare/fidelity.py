"""Measures what demosaicing and noise do to finished pictures: dots, and the distance of two.

All pictures are in sRGB levels, 0 to 255.
"""

import numpy as np
from numpy.typing import NDArray

from clpipe.base.types import Doubles
from clpipe.reference.colour import luma

DOT = 32  # levels of luma between a dot and the median of its 3x3
SMOOTH = 16  # the largest such difference in the reference, so that a dot is visible


def dots(picture: NDArray[np.number], reference: NDArray[np.number]) -> float:
    """Return the number of isolated pixels per 10,000 that the reference lacks.

    A dot's luma differs by more than 32 from the median of its 3x3. The reference's luma at the
    same place differs by at most 16.

    Args:
        picture: (height, width, 3).
        reference: the same picture without the cause of dots, such as a mosaic or noise.

    >>> grey = np.full((100, 100, 3), 128.0)
    >>> spotted = grey.copy()
    >>> spotted[50, 50] += 40
    >>> dots(spotted, grey), dots(spotted, spotted)
    (1.0, 0.0)
    """
    from scipy import ndimage

    def isolation(levels: NDArray[np.number]) -> Doubles:
        y = luma(levels)
        return np.abs(y - ndimage.median_filter(y, 3))

    return float(1e4 * ((isolation(picture) > DOT) & (isolation(reference) <= SMOOTH)).mean())


def psnr(one: NDArray[np.number], two: NDArray[np.number]) -> float:
    """Return the peak signal-to-noise ratio over all channels, dB; infinite if both are equal.

    >>> round(psnr(np.zeros((2, 2, 3)), np.ones((2, 2, 3))), 2)
    48.13
    """
    error = ((one.astype(np.float64) - two) ** 2).mean()
    return float(10 * np.log10(255**2 / error)) if error else np.inf
