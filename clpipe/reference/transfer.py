"""TODO."""

import numpy as np
from numpy.typing import NDArray


def srgb_curve(x: NDArray[np.float64]) -> NDArray[np.float64]:
    """The transfer function of sRGB (IEC 61966-2-1, 1999): linear below 0.0031308.

    >>> srgb_curve(np.array([0.001, 0.5])).round(5).tolist()
    [0.01292, 0.73536]
    """
    return np.where(x <= 0.0031308, 12.92 * x, 1.055 * x ** (1 / 2.4) - 0.055)


def inverse_srgb_curve(x: NDArray[np.float64]) -> NDArray[np.float64]:
    """From sRGB back to linear light (IEC 61966-2-1, 1999).

    >>> inverse_srgb_curve(np.array([0.01292, 0.73536])).round(4).tolist()
    [0.001, 0.5]
    """
    return np.where(x <= 0.04045, x / 12.92, ((x + 0.055) / 1.055) ** 2.4)
