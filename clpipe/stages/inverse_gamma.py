"""The transfer curve of the display, undone."""

from functools import lru_cache
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from clpipe.reference.curve import tabulate
from clpipe.stage import Curve, Kind, Stage, parameter
from clpipe.types import Floats


def inverse_srgb_curve(x: NDArray[np.float64]) -> NDArray[np.float64]:
    """From sRGB back to linear light (IEC 61966-2-1, 1999).

    >>> inverse_srgb_curve(np.array([0.01292, 0.73536])).round(4).tolist()
    [0.001, 0.5]
    """
    return np.where(x <= 0.04045, x / 12.92, ((x + 0.055) / 1.055) ** 2.4)


SRGB_TABLE = tabulate(inverse_srgb_curve)


class Srgb(Curve):
    """Undoes the transfer function of sRGB: what photographs and screens have."""

    method: ClassVar = "srgb"
    summary: ClassVar = "undo the transfer function of sRGB"

    def table(self) -> Floats:
        return SRGB_TABLE


@lru_cache(maxsize=16)
def power_table(exponent: float) -> Floats:
    """The table of x^exponent."""
    return tabulate(lambda x: x**exponent)


class Power(Curve):
    """Undoes gamma's power."""

    method: ClassVar = "power"
    summary: ClassVar = "x^exponent"

    exponent: float = parameter(2.2, "Gamma; 1 is linear.", ge=0.1, le=10)

    def table(self) -> Floats:
        return power_table(self.exponent)


STAGE = Stage(
    "inverse_gamma", "Undo the encoding for a display.", Kind.DISPLAY, Kind.RGB, (Srgb, Power)
)
