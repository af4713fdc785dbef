"""Inverse gamma: from display values back to linear light."""

from functools import lru_cache
from typing import ClassVar

from clpipe.base.types import Floats
from clpipe.reference.curve import tabulate
from clpipe.reference.transfer import inverse_srgb_curve
from clpipe.stage import Curve, Kind, Stage, parameter

SRGB_TABLE = tabulate(inverse_srgb_curve)


class Srgb(Curve):
    """The inverse of sRGB's transfer function (IEC 61966-2-1, 1999), for photographs."""

    method: ClassVar = "srgb"
    summary: ClassVar = "undo the transfer function of sRGB"

    def table(self) -> Floats:
        return SRGB_TABLE


@lru_cache(maxsize=16)
def power_table(exponent: float) -> Floats:
    """The table of x^exponent; cached, so that it is uploaded once."""
    return tabulate(lambda x: x**exponent)


class Power(Curve):
    """x^exponent, the inverse of ``gamma`` with its method ``power``."""

    method: ClassVar = "power"
    summary: ClassVar = "x^exponent"

    exponent: float = parameter(2.2, "Gamma; 1 leaves the values unchanged.", ge=0.1, le=10)

    def table(self) -> Floats:
        return power_table(self.exponent)


STAGE = Stage(
    "inverse_gamma", "Undo the encoding for a display.", Kind.DISPLAY, Kind.RGB, (Srgb, Power)
)
