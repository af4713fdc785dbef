"""The transfer curve of the display."""

from collections.abc import Mapping
from functools import lru_cache
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from clpipe.reference.curve import curve_index, tabulate
from clpipe.stage import Access, Argument, Context, Frame, Kind, Method, Pass, Stage, parameter
from clpipe.types import Floats


@lru_cache(maxsize=16)
def power_table(exponent: float) -> Floats:
    """The table of x^(1/exponent)."""
    return tabulate(lambda x: x ** (1 / exponent))


class Power(Method):
    """x^(1/exponent), as the paper."""

    method: ClassVar = "power"
    kernel: ClassVar = "curve"
    summary: ClassVar = "x^(1/exponent)"

    exponent: float = parameter(2.2, "Gamma; 1 is linear.", ge=0.1, le=10)

    def passes(self) -> tuple[Pass, ...]:
        return (Pass("curve", Access.CURVE, ("table",)),)

    def arguments(self, context: Context) -> Mapping[str, Argument]:
        return {"table": power_table(self.exponent)}

    def reference(self, image: Floats, frame: Frame) -> Floats:
        return np.asarray(power_table(self.exponent)[curve_index(image)])


def srgb_curve(x: NDArray[np.float64]) -> NDArray[np.float64]:
    """The transfer function of sRGB (IEC 61966-2-1, 1999): linear below 0.0031308.

    >>> srgb_curve(np.array([0.001, 0.5])).round(5).tolist()
    [0.01292, 0.73536]
    """
    return np.where(x <= 0.0031308, 12.92 * x, 1.055 * x ** (1 / 2.4) - 0.055)


SRGB_TABLE = tabulate(srgb_curve)


class Srgb(Method):
    """The transfer function of sRGB: what a screen undoes."""

    method: ClassVar = "srgb"
    kernel: ClassVar = "curve"
    summary: ClassVar = "the transfer function of sRGB"

    def passes(self) -> tuple[Pass, ...]:
        return (Pass("curve", Access.CURVE, ("table",)),)

    def arguments(self, context: Context) -> Mapping[str, Argument]:
        return {"table": SRGB_TABLE}

    def reference(self, image: Floats, frame: Frame) -> Floats:
        return SRGB_TABLE[curve_index(image)]


STAGE = Stage("gamma", "Encode for a display.", Kind.RGB, Kind.DISPLAY, (Power, Srgb))
