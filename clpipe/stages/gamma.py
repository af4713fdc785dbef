"""Gamma: encoding of linear light for a display."""

from functools import lru_cache
from typing import ClassVar

from clpipe.base.types import Floats
from clpipe.reference.curve import tabulate
from clpipe.reference.transfer import srgb_curve
from clpipe.stage import Curve, Kind, Stage, StageRole, parameter, pure


@pure
@lru_cache(maxsize=16)
def power_table(exponent: float) -> Floats:
    """Return the table of x^exponent; cached, so that it is uploaded once."""
    return tabulate(lambda x: x**exponent)


class Power(Curve):
    """x^(1/exponent), the encoding of the paper (Bielova et al., CVPR Workshops 2019)."""

    method: ClassVar = "power"
    summary: ClassVar = "x^(1/exponent)"

    exponent: float = parameter(2.2, "Gamma; 1 leaves the values unchanged.", ge=0.1, le=10)

    def table(self) -> Floats:
        return power_table(1 / self.exponent)


SRGB_TABLE = tabulate(srgb_curve)


class Srgb(Curve):
    """The transfer function of sRGB (IEC 61966-2-1, 1999)."""

    method: ClassVar = "srgb"
    summary: ClassVar = "the transfer function of sRGB"

    def table(self) -> Floats:
        return SRGB_TABLE


STAGE = Stage(
    "gamma",
    "Encode linear light for a display.",
    Kind.RGB,
    Kind.DISPLAY,
    (Srgb, Power),
    role=StageRole.RESPONSE,
)
