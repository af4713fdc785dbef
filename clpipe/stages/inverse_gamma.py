"""Inverse gamma: from display values back to linear light."""

from typing import ClassVar

from clpipe.base.types import Floats
from clpipe.reference.curve import tabulate
from clpipe.reference.transfer import inverse_srgb_curve
from clpipe.stage import Curve, Kind, Stage
from clpipe.stages import gamma

SRGB_TABLE = tabulate(inverse_srgb_curve)


class Srgb(Curve):
    """The inverse of sRGB's transfer function (IEC 61966-2-1, 1999), for photographs."""

    method: ClassVar = "srgb"
    summary: ClassVar = "undo the transfer function of sRGB"

    def table(self) -> Floats:
        return SRGB_TABLE


class Power(gamma.Power):
    """x^exponent, the inverse of ``gamma`` with its method ``power``."""

    summary: ClassVar = "x^exponent"

    def table(self) -> Floats:
        return gamma.power_table(self.exponent)


STAGE = Stage(
    "inverse_gamma", "Decode display values to linear light.", Kind.DISPLAY, Kind.RGB, (Srgb, Power)
)
