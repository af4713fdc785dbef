"""The transfer curve of the display."""

from collections.abc import Mapping
from functools import lru_cache
from typing import ClassVar

import numpy as np

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


STAGE = Stage("gamma", "Encode for a display.", Kind.RGB, Kind.DISPLAY, (Power,))
