"""Demosaicing along edges for any filter array."""

from functools import lru_cache
from typing import ClassVar

from clpipe.base.types import Floats
from clpipe.reference.directional_mmse import ERROR_FLOOR, MODELS, directional_mmse, models
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


@lru_cache(maxsize=16)  # equal arrays share one object, so that it is uploaded once
def tables(array: FilterArray) -> tuple[Floats, Floats]:
    """Return the filters of an array in the layout that kernels read.

    The layouts are (row, tap, model, channel, column) and (row, tap, model, column).
    """
    colours, misses = models(array)
    return kernel_table(colours.transpose(0, 2, 3, 4, 1)), kernel_table(
        misses.transpose(0, 2, 3, 1)
    )


class DirectionalMmse(Method):
    """Linear 7x7 filters under eight image models, weighted by how well each one fits.

    The models are longer along the row, the column or a diagonal, each with little or much colour.
    At each pixel, a model is weighted by how well it predicts the surrounding samples, so
    interpolation follows edges. Samples of red, green or blue keep their values up to rounding.
    """

    method: ClassVar = "directional_mmse"
    kernel: ClassVar = "demosaic_directional_mmse"
    summary: ClassVar = "mix of linear filters along four directions, for any filter array"
    tolerance: ClassVar = 1e-5  # the kernel uses fused sums of 49 terms, squares and fourth powers
    any_array: ClassVar = True

    def passes(self) -> tuple[Pass, ...]:
        error_passes = (
            Pass(name, Stencil(RADIUS), ("misses", *PERIOD), writes=name, kind=Kind.PAIR)
            for name in ERRORS
        )
        arguments = ("colours", *PERIOD, "unseen")
        blend = Pass("blend", Stencil(RADIUS), arguments, reads=("src", *ERRORS))
        return (*error_passes, blend)

    def arguments(self, context: Context) -> Arguments:
        array = context.filter_array
        colours, misses = tables(array)
        return {
            "colours": colours,
            "misses": misses,
            "unseen": ERROR_FLOOR,
            **period_of(array.period),
        }

    def reference(self, image: Floats, inputs: ReferenceContext) -> Floats:
        return directional_mmse(image, inputs.context.filter_array)
