"""Base classes that several methods share."""

from typing import Any, ClassVar, Literal, NamedTuple

import numpy as np

from clpipe.base.errors import RequestError
from clpipe.base.types import Array, Floats
from clpipe.camera.lens import LensCalibration
from clpipe.reference.curve import curve_index
from clpipe.stage.context import Context, ImageLayer, ReferenceContext
from clpipe.stage.method import Method, camera_parameter, optics_parameter, parameter
from clpipe.stage.passes import Arguments, Pass, TableLookup
from clpipe.stage.signal import SignalMethod


class Unchanged(Method):
    """Leaves the image unchanged, at no cost. A subclass may set the method's name."""

    method: ClassVar = "none"
    kernel: ClassVar = ""

    def passes(self) -> tuple[Pass, ...]:
        return ()

    def reference(self, image: Floats, inputs: ReferenceContext) -> Floats:
        return image


class LensMethod(Method):
    """An effect of the lens that ``--lens`` names, from lensfun's data."""

    method: ClassVar = "lens"
    kernel: ClassVar = ""

    def for_lens(self, lens: LensCalibration | None) -> Method:
        """Return the method for a lens; one that does nothing if lensfun has no data."""
        raise NotImplementedError(type(self).__name__)

    def resolve(self, context: Context) -> Method:
        return self.for_lens(context.optics.calibration).resolve(context)


def principal_point_parameter(name: str, edge: str, auto: str, optics: bool = False) -> Any:
    """Declare a coordinate of the principal point; arguments as for :func:`parameter`."""
    text = f"Distance of the principal point from the {edge} edge; OpenCV's {name} + 0.5."
    return parameter(None, text, "px", auto, optics=optics)


class PrincipalPointMethod(Method):
    """A method that measures positions from the principal point."""

    cx: float | None = principal_point_parameter(
        "cx", "left", "render.cx, else the centre", optics=True
    )
    cy: float | None = principal_point_parameter(
        "cy", "upper", "render.cy, else the centre", optics=True
    )


class FocalLengthMethod(Method):
    """A method that is defined in focal lengths: in px, or in mm with the width of the sensor."""

    alternatives: ClassVar = frozenset({"fx", "focal_length"})

    fx: float | None = optics_parameter("Horizontal focal length.", "px", gt=0, le=1e7)
    focal_length: float | None = optics_parameter("Focal length.", "mm", gt=0, le=1e4)
    sensor_width: float | None = optics_parameter(
        "Width of the sensor, along the longer side of the image.", "mm", gt=0, le=1e4
    )

    @property
    def relative_focal_length(self) -> float | None:
        """The focal length over the longer side; None if it is in px, or not known."""
        if self.fx or not (self.focal_length and self.sensor_width):
            return None
        return self.focal_length / self.sensor_width

    def check_focal_length(self, stage: str) -> None:
        """Check that the focal length is known, in px or in mm with the sensor's width.

        Raises:
            RequestError: it is not known. The check takes place when a chain is resolved, because
                options may choose the method, and each row of a manifest its camera.
        """
        if not self.fx and not self.relative_focal_length:
            raise RequestError(
                f"{stage}: {self.method} needs a focal length; set fx (px), or focal_length and "
                "sensor_width (mm), here or in render"
            )


class LayerMethod(Method):
    """A method that reads a layer of its image, such as its depth.

    Attributes:
        layer_kind: the kind of the layer.
        usual_layers: the names of layers that are looked for, in order of preference.
        no_layer: the layer of a chain that has no image yet.
    """

    layer_kind: ClassVar[Literal["depth", "flow"]]
    usual_layers: ClassVar[tuple[str, ...]]
    no_layer: ClassVar[ImageLayer]

    layer: str = parameter(
        "",
        "Layer of the render to read, as LAYER or LAYER=../path/{name}.exr; by default one with a "
        "usual name.",
    )

    def parse_layer(self, pixels: Array) -> Floats:
        """Return the values of :class:`ImageLayer`, from a layer, (height, width, channel).

        Raises:
            ImageError: the layer has values that are not allowed.
        """
        raise NotImplementedError(type(self).__name__)

    def check_layer(self, layer: ImageLayer) -> str:
        """Check that this (resolved) method can use a layer. Returns a warning, or "".

        Raises:
            RequestError: it cannot.
        """
        return ""

    def layer_in(self, context: Context) -> ImageLayer:
        """Return the layer of the image. Without an image, it is :attr:`no_layer`."""
        layer = context.layer() if context.layer else self.no_layer
        assert layer is not None, "the image is still there"
        return layer


class Span(NamedTuple):
    """Start and length of an exposure, in units of the first exposure."""

    start: float = 0.0
    length: float = 1.0

    @property
    def end(self) -> float:
        """The end of the exposure."""
        return self.start + self.length


class Noiseless(Unchanged):
    """A stage that only adds or only removes noise, in a chain without noise."""

    summary: ClassVar = "no noise"


class Curve(Method):
    """A curve on each channel. A subclass sets its table, see :mod:`clpipe.reference.curve`."""

    kernel: ClassVar = "curve"

    def table(self) -> Floats:
        """The table; the same object for the same parameters, so that it is uploaded once."""
        raise NotImplementedError(type(self).__name__)

    def passes(self) -> tuple[Pass, ...]:
        return (Pass("curve", TableLookup(), ("table",)),)

    def arguments(self, context: Context) -> Arguments:
        return {"table": self.table()}

    def reference(self, image: Floats, inputs: ReferenceContext) -> Floats:
        return np.asarray(self.table()[curve_index(image)])


class GaussianNoise(SignalMethod):
    """Gaussian noise of one sigma; with sigma 0 the image does not change, at no cost.

    A subclass defines the default of sigma, the passes and :meth:`apply`. If the noise is not an
    offset, it also defines the variance.
    """

    method: ClassVar = "gaussian"
    example: ClassVar = {"sigma": 0.01}

    sigma: float | None = camera_parameter(
        "Standard deviation of the offsets.", "signal", more=" and ISO", ge=0, le=1
    )

    def draw(self) -> tuple[Pass, ...]:
        """Return the kernel functions for a sigma above 0."""
        raise NotImplementedError(type(self).__name__)

    def passes(self) -> tuple[Pass, ...]:
        return self.draw() if self.sigma else ()

    def variance(self, input_variance: Floats, signal: Floats, context: Context) -> Floats:
        return input_variance + np.float32(self.sigma) ** 2


def odd_size(size: int, largest: int) -> int:
    """Check the width of a window, and return it.

    >>> odd_size(5, 15)
    5

    Raises:
        ValueError: it is even, below 1 or above ``largest``.
    """
    if size % 2 == 0 or not 1 <= size <= largest:
        raise ValueError(f"it must be odd, 1 to {largest}")
    return size
