"""Demosaicing for any filter array."""

from functools import lru_cache
from typing import ClassVar, Self

import numpy as np

from clpipe.base.errors import RequestError
from clpipe.base.types import Floats
from clpipe.reference.filter_array import FilterArray, kernel_table
from clpipe.reference.linear_mmse import RADIUS, filters, linear_mmse
from clpipe.stage import (
    PERIOD,
    Arguments,
    Context,
    Method,
    Pass,
    Pointwise,
    ReferenceContext,
    Stencil,
    period_of,
)


@lru_cache(maxsize=16)  # one object for the same array, so that it is uploaded once
def weights_table(array: FilterArray) -> Floats:
    """The filters of an array as kernels load them: (row, tap, channel, column)."""
    return kernel_table(filters(array).transpose(0, 2, 3, 1))


class LinearMmse(Method):
    """For each place of the period, the linear filter of 7x7 that leaves the least mean square
    error under a model of images (after Trussell and Hartley, ICIP 2002).

    >>> from clpipe.stage import run_reference
    >>> run_reference(LinearMmse(), np.full((4, 4), 0.5, np.float32))[1, 2].round(6).tolist()
    [0.5, 0.5, 0.5]
    """

    method: ClassVar = "linear_mmse"
    kernel: ClassVar = "demosaic_linear_mmse"
    summary: ClassVar = "the best linear filters of 7x7, for any filter array"
    any_array: ClassVar = True

    def passes(self) -> tuple[Pass, ...]:
        return (Pass("linear_mmse", Stencil(RADIUS), ("weights", *PERIOD)),)

    def arguments(self, context: Context) -> Arguments:
        array = context.filters
        return {"weights": weights_table(array), **period_of(array.period)}

    def reference(self, image: Floats, given: ReferenceContext) -> Floats:
        return linear_mmse(image, given.context.filters)


class Gray(Method):
    """The mosaic in red, green and blue alike: for a sensor without filters.

    >>> from clpipe.camera.profile import load_camera
    >>> from clpipe.reference.filter_array import parse_array
    >>> context = Context(load_camera("sony-a7r2"), 100, array=parse_array("mono"))
    >>> Gray().reference(np.float32([[0.25]]), ReferenceContext(context, {}, {})).tolist()
    [[[0.25, 0.25, 0.25]]]
    """

    method: ClassVar = "gray"
    kernel: ClassVar = "demosaic_gray"
    summary: ClassVar = "no colours: for a sensor without filters"
    any_array: ClassVar = True
    only_arrays: ClassVar = ("mono",)

    def resolve(self, context: Context) -> Self:
        """The method itself.

        Raises:
            RequestError: the sensor has filters of several kinds.
        """
        if not context.filters.is_gray:
            raise RequestError(
                f"demosaic.method=gray: it is for sensors of one channel, but the mosaic is "
                f"{context.filters.name}; leave demosaic.method out, or choose another one"
            )
        return self

    def passes(self) -> tuple[Pass, ...]:
        return (Pass("gray", Pointwise()),)

    def reference(self, image: Floats, given: ReferenceContext) -> Floats:
        return np.repeat(image[..., None], 3, axis=-1)
