"""Parts that several methods have in common: bases to derive from, and a check of window sizes."""

from typing import ClassVar, NamedTuple

import numpy as np

from clpipe.base.errors import RequestError
from clpipe.base.types import Floats
from clpipe.camera.lens import LensCalibration
from clpipe.reference.curve import curve_index
from clpipe.reference.defocus import Depth
from clpipe.stage.context import Context, ReferenceContext
from clpipe.stage.method import Method, parameter
from clpipe.stage.passes import Arguments, Pass, TableLookup
from clpipe.stage.signal import SignalMethod


class Unchanged(Method):
    """Leaves the image as it is, at no cost. A subclass gives the method's name."""

    kernel: ClassVar = ""

    def passes(self) -> tuple[Pass, ...]:
        return ()

    def reference(self, image: Floats, given: ReferenceContext) -> Floats:
        return image


class FromLens(Method):
    """An effect of the lens that ``--lens`` names, as lensfun knows it."""

    method: ClassVar = "lens"
    kernel: ClassVar = ""

    def of_lens(self, lens: LensCalibration | None) -> Method:
        """The method that does it; one that leaves the image as it is where nothing is known."""
        raise NotImplementedError(type(self).__name__)

    def resolve(self, context: Context) -> Method:
        return self.of_lens(context.optics.calibration).resolve(context)


class AboutAxis(Method):
    """A method that counts from the principal point."""

    cx: float | None = parameter(
        None,
        "Principal point, from the left edge: OpenCV's cx + 0.5.",
        "px",
        "render.cx, the middle",
        optics=True,
    )
    cy: float | None = parameter(
        None,
        "Principal point, from the upper edge: OpenCV's cy + 0.5.",
        "px",
        "render.cy, the middle",
        optics=True,
    )


class InFocalLengths(Method):
    """A method that counts in focal lengths: px, or mm over the width of the sensor."""

    alternatives: ClassVar = frozenset({"fx", "focal_length"})

    fx: float | None = parameter(
        None, "Focal length across.", "px", "the camera's", optics=True, gt=0, le=1e7
    )
    focal_length: float | None = parameter(
        None, "Focal length.", "mm", "the camera's", optics=True, gt=0, le=1e4
    )
    sensor_width: float | None = parameter(
        None,
        "Of the sensor, along the longer side of the image.",
        "mm",
        "the camera's",
        optics=True,
        gt=0,
        le=1e4,
    )

    @property
    def share(self) -> float | None:
        """The focal length over the longer side; None where it is in px, or not known."""
        if self.fx or not (self.focal_length and self.sensor_width):
            return None
        return self.focal_length / self.sensor_width

    def check_focal_length(self, stage: str) -> None:
        """See that the focal length is known, in one of the two ways.

        Raises:
            RequestError: it is not. It is refused when a chain is resolved because options may
                choose the method, and each row of a manifest its camera.
        """
        if not self.fx and not self.share:
            raise RequestError(
                f"{stage}: {self.method} counts in focal lengths: set fx (px), or focal_length "
                "and sensor_width (mm), here or in render"
            )


class OfDepth(Method):
    """A method that needs the depth of its image, which :attr:`Context.depth` then has."""

    layer: str = parameter("", "The layer that has the depth; else one of a usual name.")

    def check_depth(self, depth: Depth) -> str:
        """See that this (resolved) method can use a depth: a warning, or "".

        Raises:
            RequestError: it cannot.
        """
        raise NotImplementedError(type(self).__name__)


class Span(NamedTuple):
    """When an exposure begins, and how long it is, in exposures of the first one."""

    start: float = 0.0
    length: float = 1.0

    @property
    def end(self) -> float:
        """When it ends."""
        return self.start + self.length


class Noiseless(Unchanged):
    """A stage that only adds noise, or only takes it away, where there is none."""

    method: ClassVar = "none"
    summary: ClassVar = "no noise"


class Curve(Method):
    """A curve on each channel. A subclass gives its table, see :mod:`clpipe.reference.curve`."""

    kernel: ClassVar = "curve"

    def table(self) -> Floats:
        """The table; the same object for the same parameters, so that it is uploaded once."""
        raise NotImplementedError(type(self).__name__)

    def passes(self) -> tuple[Pass, ...]:
        return (Pass("curve", TableLookup(), ("table",)),)

    def arguments(self, context: Context) -> Arguments:
        return {"table": self.table()}

    def reference(self, image: Floats, given: ReferenceContext) -> Floats:
        return np.asarray(self.table()[curve_index(image)])


class GaussianNoise(SignalMethod):
    """Gaussian noise of one sigma; at sigma 0 the image stays as it is, at no cost.

    A subclass gives the default of sigma, the passes and :meth:`apply`; and the variance, if the
    noise is not an offset.
    """

    method: ClassVar = "gaussian"
    example: ClassVar = {"sigma": 0.01}

    sigma: float | None = parameter(
        None,
        "Standard deviation of the offsets.",
        "signal",
        "from the camera and ISO",
        ge=0,
        le=1,
    )

    def draw(self) -> tuple[Pass, ...]:
        """The kernel functions for a sigma above 0."""
        raise NotImplementedError(type(self).__name__)

    def passes(self) -> tuple[Pass, ...]:
        return self.draw() if self.sigma else ()

    def variance(self, before: Floats, signal: Floats, context: Context) -> Floats:
        return before + np.float32(self.sigma) ** 2

    def arguments(self, context: Context) -> Arguments:
        return {"sigma": self.sigma}


def odd_size(size: int, largest: int) -> int:
    """The width of a window, checked.

    >>> odd_size(5, 15)
    5

    Raises:
        ValueError: it is even, below 1 or above ``largest``.
    """
    if size % 2 == 0 or not 1 <= size <= largest:
        raise ValueError(f"it must be odd, 1 to {largest}")
    return size
