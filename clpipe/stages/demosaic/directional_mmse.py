"""Demosaicing for any filter array, along edges."""

from functools import lru_cache
from typing import ClassVar

from clpipe.base.types import Floats
from clpipe.reference.directional_mmse import MODELS, UNSEEN, directional_mmse, models
from clpipe.reference.filter_array import FilterArray, kernel_table
from clpipe.reference.linear_mmse import RADIUS
from clpipe.stage import (
    PERIOD,
    Arguments,
    Context,
    Kind,
    Method,
    Pass,
    ReferenceContext,
    Stencil,
    period_of,
)

ERRORS = tuple(f"errors_{first}" for first in range(0, MODELS, 2))


@lru_cache(maxsize=16)  # one object for the same array, so that it is uploaded once
def tables(array: FilterArray) -> tuple[Floats, Floats]:
    """The filters of an array as kernels load them.

    (row, tap, model, channel, column), and (row, tap, model, column).
    """
    colours, misses = models(array)
    return kernel_table(colours.transpose(0, 2, 3, 4, 1)), kernel_table(
        misses.transpose(0, 2, 3, 1)
    )


class DirectionalMmse(Method):
    """Linear filters of 7x7 under eight models of images: longer along the row, the column or a
    diagonal, with little colour or much. At each pixel each counts by how well it foretells the
    samples around, so edges are interpolated along themselves. A sample of red, green or blue is
    kept up to rounding.
    """

    method: ClassVar = "directional_mmse"
    kernel: ClassVar = "demosaic_directional_mmse"
    summary: ClassVar = "the best of linear filters along four directions, for any filter array"
    tolerance: ClassVar = 1e-5  # fused sums of 49, squared, and to the power of four
    any_array: ClassVar = True

    def passes(self) -> tuple[Pass, ...]:
        foretold = (
            Pass(name, Stencil(RADIUS), ("misses", *PERIOD), writes=name, kind=Kind.PAIR)
            for name in ERRORS
        )
        arguments = ("colours", *PERIOD, "unseen")
        blend = Pass("blend", Stencil(RADIUS), arguments, reads=("src", *ERRORS))
        return (*foretold, blend)

    def arguments(self, context: Context) -> Arguments:
        array = context.filters
        colours, misses = tables(array)
        return {
            "colours": colours,
            "misses": misses,
            "unseen": UNSEEN,
            **period_of(array.period),
        }

    def reference(self, image: Floats, given: ReferenceContext) -> Floats:
        return directional_mmse(image, given.context.filters)
