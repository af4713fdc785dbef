"""Demosaicing with linear filters for any filter array."""

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


@lru_cache(maxsize=16)  # equal arrays share one object, so that it is uploaded once
def weights_table(array: FilterArray) -> Floats:
    """Return the filters of an array in the layout of kernels: (row, tap, channel, column)."""
    return kernel_table(filters(array).transpose(0, 2, 3, 1))


class LinearMmse(Method):
    """Linear 7x7 filters with the least mean square error under a model of images.

    Each position of the array's period has its own filter (after Trussell and Hartley, ICIP 2002).

    >>> from clpipe.stage import run_reference
    >>> run_reference(LinearMmse(), np.full((4, 4), 0.5, np.float32))[1, 2].round(6).tolist()
    [0.5, 0.5, 0.5]
    """

    method: ClassVar = "linear_mmse"
    kernel: ClassVar = "demosaic_linear_mmse"
    summary: ClassVar = "linear 7x7 filters with the least mean square error, for any filter array"
    any_array: ClassVar = True

    def passes(self) -> tuple[Pass, ...]:
        return (Pass("linear_mmse", Stencil(RADIUS), ("weights", *PERIOD)),)

    def arguments(self, context: Context) -> Arguments:
        array = context.filter_array
        return {"weights": weights_table(array), **period_of(array.period)}

    def reference(self, image: Floats, inputs: ReferenceContext) -> Floats:
        return linear_mmse(image, inputs.context.filter_array)


class Gray(Method):
    """Copies the mosaic to red, green and blue, for a sensor without filters.

    >>> from clpipe.camera.profile import load_camera
    >>> from clpipe.reference.filter_array import parse_array
    >>> context = Context(load_camera("sony-a7r2"), 100, array=parse_array("mono"))
    >>> Gray().reference(np.float32([[0.25]]), ReferenceContext(context, {}, {})).tolist()
    [[[0.25, 0.25, 0.25]]]
    """

    method: ClassVar = "gray"
    kernel: ClassVar = "demosaic_gray"
    summary: ClassVar = "copy the mosaic to red, green and blue, for a sensor without filters"
    any_array: ClassVar = True
    only_arrays: ClassVar = ("mono",)

    def resolve(self, context: Context) -> Self:
        """Return the method itself.

        Raises:
            RequestError: the sensor has several kinds of filters.
        """
        if not context.filter_array.is_gray:
            raise RequestError(
                "demosaic.method=gray is for sensors of one channel, but the mosaic is "
                f"{context.filter_array.name}; remove demosaic.method, or choose another method"
            )
        return self

    def passes(self) -> tuple[Pass, ...]:
        return (Pass("gray", Pointwise()),)

    def reference(self, image: Floats, inputs: ReferenceContext) -> Floats:
        return np.repeat(image[..., None], 3, axis=-1)
