"""Freeman's demosaicing: bilinear, with median filtered colour differences."""

import typing
from typing import ClassVar

import numpy as np

from clpipe.base.types import Floats
from clpipe.reference.median import median_filter
from clpipe.stage import (
    Arguments,
    CompileTime,
    Context,
    Kind,
    Method,
    Pass,
    ReferenceContext,
    Stencil,
    parameter,
)
from clpipe.stages.demosaic.bilinear import bilinear
from clpipe.stages.demosaic.common import from_differences


class Median(Method):
    """Bilinear interpolation, then a median filter on R-G and B-G (Freeman, 1988).

    US patent 4,724,395. The sensor's samples stay as they are; the missing colours follow from them
    and the filtered differences.
    """

    method: ClassVar = "median"
    kernel: ClassVar = "demosaic_median"
    summary: ClassVar = "bilinear, then colour differences median filtered (Freeman)"

    size: typing.Literal[3, 5] = parameter(
        3, "Width and height of the median filter.", "px", structural=True
    )

    def passes(self) -> tuple[Pass, ...]:
        return (
            Pass(
                "bilinear_differences",
                Stencil(1),
                ("pattern",),
                writes="spread",
                kind=Kind.PAIR,
            ),
            self.median_pass(),
        )

    def median_pass(self) -> Pass:
        """The pass that filters the colour differences, an image named "spread", and gives RGB."""
        arguments, reads = ("pattern", "size"), ("src", "spread")
        return Pass("freeman", Stencil(self.size // 2), arguments, reads)

    def arguments(self, context: Context) -> Arguments:
        return {"pattern": context.cfa, "size": CompileTime(str(self.size))}

    def reference(self, image: Floats, given: ReferenceContext) -> Floats:
        pattern = given.context.pattern
        red, green, blue = np.moveaxis(bilinear(image, pattern), -1, 0)
        differences = (median_filter(d, self.size) for d in (red - green, blue - green))
        return from_differences(image, pattern, *differences)
