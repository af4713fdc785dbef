"""Smaller pictures."""

from typing import ClassVar

from clpipe.base.types import Floats
from clpipe.reference.geometry import Scaling
from clpipe.reference.resample import Resampling, Weight, lanczos3, overlap, resample
from clpipe.stage import Kind, Method, Pass, ReferenceContext, Resample, parameter, rgb_stage


class Filter(Method):
    """A weighted mean of surrounding pixels, first of rows, then of columns.

    WIDTH x HEIGHT becomes round(WIDTH * scale) x round(HEIGHT * scale), at least 1 pixel each. Each
    side is scaled by the ratio of its rounded sizes, so the field of view does not change.
    """

    kernel: ClassVar = "resize"
    example: ClassVar = {"scale": 0.4}
    filter: ClassVar[tuple[Weight, float]]  # weight and support, see Resampling

    scale: float = parameter(
        1.0, "New width over old width; the height is scaled likewise.", ge=1 / 8, le=1
    )

    def passes(self) -> tuple[Pass, ...]:
        if self.scale == 1:
            return ()
        rows, columns = self.resamplings
        return (
            Pass("resize_rows", Resample(rows), writes="fewer_rows"),
            Pass("resize_columns", Resample(columns), reads=("fewer_rows",)),
        )

    def geometry(self) -> Scaling | None:
        return Scaling(self.resamplings) if self.passes() else None

    @property
    def resamplings(self) -> tuple[Resampling, Resampling]:
        """The resamplings of rows and of columns."""
        weight, support = self.filter
        return (
            Resampling("rows", self.scale, weight, support),
            Resampling("columns", self.scale, weight, support),
        )

    def reference(self, image: Floats, inputs: ReferenceContext) -> Floats:
        if self.scale == 1:
            return image
        rows, columns = self.resamplings
        return resample(resample(image, rows), columns)


class Area(Filter):
    """Mean over the area of the new pixel, including fractions of pixels at its edges.

    >>> import numpy as np
    >>> from clpipe.stage import run_reference
    >>> grey = np.float32([[0, 2, 4, 6], [2, 4, 6, 8]])[..., None].repeat(3, 2)
    >>> run_reference(Area(scale=0.5), grey)[..., 0].tolist()
    [[2.0, 6.0]]
    """

    method: ClassVar = "area"
    summary: ClassVar = "mean over the area of each new pixel"
    filter: ClassVar = (overlap, 0.5)


class Lanczos3(Filter):
    """The sinc windowed by a wider sinc, three lobes on each side: sharper than the mean.

    It rings next to edges, also below 0 and above 1. Samples outside the image have no weight.
    """

    method: ClassVar = "lanczos3"
    summary: ClassVar = "windowed sinc with three lobes: sharp, and rings a little"
    example: ClassVar = {"scale": 0.7}
    filter: ClassVar = (lanczos3, 3.0)


STAGE = rgb_stage("resize", "Reduce the image size.", (Area, Lanczos3), also_reads=(Kind.DISPLAY,))
