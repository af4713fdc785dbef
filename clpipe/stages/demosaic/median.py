"""Freeman's median filter of colour differences, after bilinear or edge-directed interpolation."""

import typing
from typing import ClassVar

import numpy as np

from clpipe.base.types import Floats
from clpipe.reference.median import median_filter
from clpipe.stage import Kind, Method, Pass, ReferenceContext, Stencil, parameter
from clpipe.stages.demosaic.bilinear import bilinear
from clpipe.stages.demosaic.common import from_differences, spread_differences
from clpipe.stages.demosaic.edge_directed import EdgeDirected, green_or_difference


class Median(Method):
    """Bilinear interpolation, then a median filter on R-G and B-G (Freeman, 1988).

    US patent 4,724,395. The sensor's samples do not change. The missing colours follow from them
    and the filtered differences.
    """

    method: ClassVar = "median"
    kernel: ClassVar = "demosaic_median"
    summary: ClassVar = "bilinear, then a median filter on the colour differences (Freeman)"

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
        """The pass that filters the colour differences, named "spread", and returns RGB."""
        arguments, reads = ("pattern", "size"), ("src", "spread")
        return Pass("freeman", Stencil(self.size // 2), arguments, reads)

    def reference(self, image: Floats, inputs: ReferenceContext) -> Floats:
        pattern = inputs.context.pattern
        red, green, blue = np.moveaxis(bilinear(image, pattern), -1, 0)
        differences = (median_filter(d, self.size) for d in (red - green, blue - green))
        return from_differences(image, pattern, *differences)


class EdgeDirectedMedian(Median, EdgeDirected):
    """``edge_directed``, then the median filter of ``median`` on the colour differences.

    The paper (Bielova et al., CVPR Workshops 2019) uses this combination.
    """

    method: ClassVar = "edge_directed_median"
    kernel: ClassVar = "demosaic_edge_directed_median"
    summary: ClassVar = "green along edges, then a median filter on the colour differences"

    def passes(self) -> tuple[Pass, ...]:
        green, _ = EdgeDirected.passes(self)
        spread = Pass(
            "spread_differences",
            Stencil(1),
            ("pattern",),
            reads=("known",),
            writes="spread",
            kind=Kind.PAIR,
        )
        return green, spread, self.median_pass()

    def reference(self, image: Floats, inputs: ReferenceContext) -> Floats:
        pattern = inputs.context.pattern
        sparse = green_or_difference(image, pattern, self.classifier)
        differences = spread_differences(sparse, pattern)
        return from_differences(image, pattern, *(median_filter(d, self.size) for d in differences))
