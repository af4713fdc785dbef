"""The transfer curve of the display."""

from functools import lru_cache
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from clpipe.reference.curve import tabulate
from clpipe.stage import Curve, Kind, Stage, parameter
from clpipe.types import Floats


@lru_cache(maxsize=16)
def power_table(exponent: float) -> Floats:
    """The table of x^(1/exponent)."""
    return tabulate(lambda x: x ** (1 / exponent))


class Power(Curve):
    """x^(1/exponent), as the paper."""

    method: ClassVar = "power"
    summary: ClassVar = "x^(1/exponent)"

    exponent: float = parameter(2.2, "Gamma; 1 is linear.", ge=0.1, le=10)

    def table(self) -> Floats:
        return power_table(self.exponent)


def srgb_curve(x: NDArray[np.float64]) -> NDArray[np.float64]:
    """The transfer function of sRGB (IEC 61966-2-1, 1999): linear below 0.0031308.

    >>> srgb_curve(np.array([0.001, 0.5])).round(5).tolist()
    [0.01292, 0.73536]
    """
    return np.where(x <= 0.0031308, 12.92 * x, 1.055 * x ** (1 / 2.4) - 0.055)


SRGB_TABLE = tabulate(srgb_curve)


class Srgb(Curve):
    """The transfer function of sRGB: what a screen undoes."""

    method: ClassVar = "srgb"
    summary: ClassVar = "the transfer function of sRGB"

    def table(self) -> Floats:
        return SRGB_TABLE


STAGE = Stage("gamma", "Encode for a display.", Kind.RGB, Kind.DISPLAY, (Power, Srgb))
