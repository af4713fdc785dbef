"""Remosaicing: from cells of equal filters to a Bayer pattern, like in quad sensors."""

import math
from dataclasses import replace
from functools import lru_cache
from typing import ClassVar, Self

import numpy as np
from pydantic import PrivateAttr

from clpipe.base.errors import RequestError
from clpipe.base.types import Floats
from clpipe.reference.cfa import Pattern
from clpipe.reference.filter_array import FilterArray, kernel_table, parse_array
from clpipe.reference.geometry import Scaling
from clpipe.reference.linear_mmse import RADIUS, apply_filters, filters
from clpipe.reference.resample import Bins, resample
from clpipe.stage import (
    PERIOD,
    Arguments,
    Context,
    Kind,
    Method,
    Pass,
    ReferenceContext,
    Resample,
    Stage,
    Stencil,
    parameter,
    period_of,
)


class Binning(Method):
    """The mean of each cell of equal filters: digital binning of 2x2 or 3x3 pixels.

    Noise that is already present decreases like in a mean of 4 or 9. Between mosaic and
    sensor_noise, the stage bins charge, and noise is added once per cell. Rows and columns after
    the last whole cell are cropped.

    >>> from clpipe.stage import Context, ReferenceContext
    >>> from clpipe.camera.profile import load_camera
    >>> context = Context(load_camera("sony-a7r2"), 100, array=parse_array("quad-RGGB"))
    >>> mosaic = np.float32([[1, 3, 5, 7], [1, 3, 5, 7]])
    >>> Binning().resolve(context).reference(mosaic, ReferenceContext(context, {}, {})).tolist()
    [[2.0, 6.0]]
    """

    method: ClassVar = "binning"
    kernel: ClassVar = "remosaic_binning"
    summary: ClassVar = "mean of each cell, for half or a third of the width and height"
    any_array: ClassVar = True
    only_arrays: ClassVar = ("quad-RGGB", "nona-RGGB")

    _factor: int = PrivateAttr(2)

    def resolve(self, context: Context) -> Self:
        array = context.filter_array
        factor = next((n for n in (3, 2) if binned(array, n)), None)
        if factor is None:
            raise RequestError(
                f"remosaic.method=binning: the mosaic is {array.name}; binning needs cells of "
                "2x2 or 3x3 equal filters, for example quad-RGGB and nona-RGGB"
            )
        return self.with_state(_factor=factor)

    def next_context(self, context: Context) -> Context:
        array = binned(context.filter_array, self._factor)
        assert array
        pixels_per_cell, noise = self._factor**2, context.noise
        binned_noise = noise and replace(
            noise, a=noise.a / pixels_per_cell, b=noise.b / pixels_per_cell
        )
        return context.with_array(array).replace(noise=binned_noise)

    @property
    def bins(self) -> tuple[Bins, Bins]:
        """The binning of rows and of columns."""
        return Bins("rows", self._factor), Bins("columns", self._factor)

    def passes(self) -> tuple[Pass, ...]:
        rows, columns = self.bins
        return (
            Pass("bin_rows", Resample(rows), writes="fewer_rows"),
            Pass("bin_columns", Resample(columns), reads=("fewer_rows",)),
        )

    def geometry(self) -> Scaling | None:
        return Scaling(self.bins)

    def reference(self, image: Floats, inputs: ReferenceContext) -> Floats:
        rows, columns = self.bins
        return resample(resample(image, rows), columns)


def binned(array: FilterArray, factor: int) -> FilterArray | None:
    """Return the array after binning cells of equal filters; None if it has no such cells.

    >>> binned(parse_array("quad-RGGB"), 2).rows, binned(parse_array("x-trans"), 2)
    (('RG', 'GB'), None)
    """
    rows, columns = array.period
    if rows % factor or columns % factor:
        return None
    reduced = array.letters[::factor, ::factor]
    if not (reduced.repeat(factor, 0).repeat(factor, 1) == array.letters).all():
        return None
    text = "/".join("".join(row) for row in reduced)
    return parse_array(text, array.gains)


class LinearMmse(Method):
    """Samples that match the Bayer pattern are kept, others come from linear 7x7 filters.

    The filters come from ``demosaic.method=linear_mmse``, so the mosaic must be white-balanced.
    """

    method: ClassVar = "linear_mmse"
    kernel: ClassVar = "remosaic_linear_mmse"
    summary: ClassVar = "a Bayer pattern of full size, by linear 7x7 filters"
    any_array: ClassVar = True

    pattern: Pattern = parameter("RGGB", "Bayer pattern of the result.", structural=True)

    def next_context(self, context: Context) -> Context:
        return context.replace(array=None, pattern=self.pattern)

    def passes(self) -> tuple[Pass, ...]:
        return (Pass("remosaic", Stencil(RADIUS), ("weights", *PERIOD)),)

    def arguments(self, context: Context) -> Arguments:
        weights = weights_of(context.filter_array, self.pattern)
        return {
            "weights": table_of(context.filter_array, self.pattern),
            **period_of(weights.shape[:2]),
        }

    def reference(self, image: Floats, inputs: ReferenceContext) -> Floats:
        array = inputs.context.filter_array
        weights = weights_of(array, self.pattern)
        return apply_filters(image, array.period, weights[..., None])[..., 0]


@lru_cache(maxsize=16)
def weights_of(array: FilterArray, pattern: Pattern) -> Floats:
    """Return the filter at each position of the common period: (row, column, tap)."""
    target = parse_array(pattern)
    rows, columns = (math.lcm(a, b) for a, b in zip(array.period, target.period, strict=True))
    array_filters = filters(array)
    positions = np.ix_(np.arange(rows) % array.period[0], np.arange(columns) % array.period[1])
    channel = np.vectorize("RGB".index)(np.tile(target.letters, (rows // 2, columns // 2)))
    selected = np.take_along_axis(array_filters[positions], channel[..., None, None], axis=-1)
    return np.ascontiguousarray(selected[..., 0])


@lru_cache(maxsize=16)  # equal arrays share one object, so that it is uploaded once
def table_of(array: FilterArray, pattern: Pattern) -> Floats:
    """Return :func:`weights_of` in the layout of kernels: (row, tap, column)."""
    return kernel_table(weights_of(array, pattern).transpose(0, 2, 1))


STAGE = Stage(
    "remosaic",
    "Convert a quad or other filter array to a Bayer pattern.",
    Kind.MOSAIC,
    Kind.MOSAIC,
    (Binning, LinearMmse),
)
