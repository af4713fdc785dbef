"""Edge-directed demosaicing with Freeman's median step."""

from typing import ClassVar

from clpipe.base.types import Floats
from clpipe.reference.median import median_filter
from clpipe.stage import Arguments, Context, Kind, Pass, ReferenceContext, Stencil
from clpipe.stages.demosaic.common import from_differences, spread_differences
from clpipe.stages.demosaic.edge_directed import EdgeDirected, green_or_difference
from clpipe.stages.demosaic.median import Median


class EdgeDirectedMedian(Median, EdgeDirected):
    """``edge_directed`` with its colour differences median filtered, as ``median`` does.

    The paper's own combination (Bielova et al., CVPR Workshops 2019).
    """

    method: ClassVar = "edge_directed_median"
    kernel: ClassVar = "demosaic_edge_directed_median"
    summary: ClassVar = "green along edges, then colour differences median filtered"

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

    def arguments(self, context: Context) -> Arguments:
        return {**EdgeDirected.arguments(self, context), **Median.arguments(self, context)}

    def reference(self, image: Floats, given: ReferenceContext) -> Floats:
        pattern = given.context.pattern
        sparse = green_or_difference(image, pattern, self.classifier)
        differences = spread_differences(sparse, pattern)
        return from_differences(image, pattern, *(median_filter(d, self.size) for d in differences))
