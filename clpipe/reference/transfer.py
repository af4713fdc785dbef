"""Transfer functions between linear light and display values, both 0..1.

They are in no kernel header: kernels read them from tables, see :mod:`clpipe.reference.curve`.
"""

import numpy as np

from clpipe.base.types import Doubles


def srgb_curve(x: Doubles) -> Doubles:
    """Convert linear light to sRGB (IEC 61966-2-1, 1999): a straight line up to 0.0031308.

    >>> srgb_curve(np.array([0.001, 0.5])).round(5).tolist()
    [0.01292, 0.73536]
    """
    return np.where(x <= 0.0031308, 12.92 * x, 1.055 * x ** (1 / 2.4) - 0.055)


def inverse_srgb_curve(x: Doubles) -> Doubles:
    """Convert sRGB to linear light (IEC 61966-2-1, 1999): a straight line up to 0.04045.

    >>> inverse_srgb_curve(np.array([0.01292, 0.73536])).round(4).tolist()
    [0.001, 0.5]
    """
    return np.where(x <= 0.04045, x / 12.92, ((x + 0.055) / 1.055) ** 2.4)
