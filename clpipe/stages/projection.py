"""Wide lenses, to 220 degrees: the image is made from a render of the whole surroundings.

The render is six faces of a cube, several overlapping views, a map of longitude and latitude, or
one view. The model (:mod:`clpipe.reference.wide`) gives the direction that each pixel of the image
sees. Each channel is then sampled in that direction (:mod:`clpipe.reference.projection`).
"""

from collections.abc import Mapping
from dataclasses import replace
from typing import Any, ClassVar, Literal, Self

from pydantic import PrivateAttr

from clpipe.base.errors import RequestError
from clpipe.base.types import Floats
from clpipe.reference.panorama import Panorama
from clpipe.reference.projection import Projection
from clpipe.reference.wide import WideLens
from clpipe.stage import (
    Arguments,
    Context,
    Method,
    Pass,
    ReferenceContext,
    Resample,
    StageRole,
    Unchanged,
    parameter,
    principal_point_parameter,
    rgb_stage,
)
from clpipe.stages.distortion import filter_arguments


class NoProjection(Unchanged):
    """The image keeps the render's perspective."""

    summary: ClassVar = "keep the render's perspective"


class WideAngle(Method):
    """A wide lens with a sensor."""

    kernel: ClassVar = "projection"

    cx: float | None = principal_point_parameter("cx", "left", "the centre")
    cy: float | None = principal_point_parameter("cy", "upper", "the centre")
    width: int | None = parameter(
        None, "Width of the image.", "px", "that of the whole field of view", ge=1, le=65536
    )
    height: int | None = parameter(
        None, "Height of the image.", "px", "that of the whole field of view", ge=1, le=65536
    )
    field_of_view: float = parameter(
        180.0,
        "Field of view, through the axis; pixels outside it are black.",
        "degrees",
        gt=1,
        le=220,
    )
    source: Literal["auto", "map"] = parameter(
        "auto",
        "Layout of the render. map is a map of longitude and latitude. auto uses the file's "
        "metadata or the names of the files, and otherwise assumes a perspective view.",
    )
    face_angle: float | None = parameter(
        None,
        "Horizontal field of view of a cube's face, or of a view.",
        "degrees",
        "90 for a cube, else from the render's focal length",
        gt=1,
        lt=179,
    )
    views: str | None = parameter(
        None,
        "File with the cameras of overlapping renders, as for --poses. Its world axes are those "
        "of the image, and the names of the renders end with the names of the views.",
        "",
        "the faces of a cube",
        file=True,
    )
    filter: Literal["bicubic", "lanczos3"] = parameter(
        "bicubic",
        "Resampling filter: bicubic (Catmull-Rom), or lanczos3, which is sharper and rings.",
        structural=True,
    )

    _panorama: Panorama | None = PrivateAttr(None)
    _optics: tuple[tuple[str, float], ...] = PrivateAttr(())

    def with_panorama(self, panorama: Panorama) -> Self:
        """Return the (resolved) method for an image that is the atlas of a panorama."""
        return self.with_state(_panorama=panorama)

    def with_image_state_of(self, other: Method) -> Self:
        updated = super().with_image_state_of(other)
        panorama = other._panorama if isinstance(other, WideAngle) else None
        return updated.with_panorama(panorama) if panorama else updated

    def resolve(self, context: Context) -> Self:
        return self.with_state(_optics=tuple(context.optics.known.items()))

    def next_context(self, context: Context) -> Context:
        return context.without_view()

    def lens(self) -> WideLens:
        """The lens."""
        raise NotImplementedError(type(self).__name__)

    def _lens(self, coefficients: tuple[float, ...], fx: float, fy: float) -> WideLens:
        """A lens of the method's model."""
        full_lens = WideLens(self.method, coefficients, fx, fy, self.field_of_view)
        if self.width and self.height:
            size = self.width, self.height
        else:
            width, height = full_lens.picture
            size = self.width or width, self.height or height
        return replace(full_lens, size=size, centre=(self.cx, self.cy))

    def geometry(self) -> Projection:
        source = self._panorama, self.source == "map", self.face_angle, self._optics
        return Projection(self.lens(), self.filter, *source)

    def passes(self) -> tuple[Pass, ...]:
        projection = self.geometry()
        access = Resample(projection, projection.support)
        return (Pass("projection", access, ("filter", "taps", "powers")),)

    def arguments(self, context: Context) -> Arguments:
        return filter_arguments(self.filter)

    def reference(self, image: Floats, inputs: ReferenceContext) -> Floats:
        return self.geometry().reference(image)


class PixelFocalLengths(WideAngle):
    """A model that is defined in focal lengths."""

    fx: float | None = parameter(
        None, "Horizontal focal length.", "px", "none: you must set it", gt=0, le=1e7
    )
    fy: float | None = parameter(None, "Vertical focal length.", "px", "fx", gt=0, le=1e7)

    def resolve(self, context: Context) -> Self:
        """Return the method with both focal lengths.

        Raises:
            RequestError: there is no focal length.
        """
        if not self.fx:
            raise RequestError(
                f"projection.fx: {self.method} needs the lens's focal length in px; set "
                "projection.fx to about the image's width divided by the field of view in "
                "radians"
            )
        return super().resolve(context).with_defaults(fy=self.fx)

    def coefficients(self) -> tuple[float, ...]:
        """The coefficients of the model, in its order."""
        raise NotImplementedError(type(self).__name__)

    def lens(self) -> WideLens:
        assert self.fx
        assert self.fy
        return self._lens(self.coefficients(), self.fx, self.fy)


EXAMPLE: Mapping[str, Any] = {"face_angle": 30.0, "width": 203, "height": 150}


class KannalaBrandt(PixelFocalLengths):
    """r = a (1 + k1 a^2 + k2 a^4 + k3 a^6 + k4 a^8), where a is the angle to the axis.

    OpenCV's fisheye model, COLMAP's OPENCV_FISHEYE (Kannala and Brandt, PAMI 2006). With zeros it
    is the equidistant projection.
    """

    method: ClassVar = "kannala_brandt"
    summary: ClassVar = "OpenCV's fisheye model: a polynomial of the angle to the axis"
    example: ClassVar = {**EXAMPLE, "fx": 380.0, "fy": 390.0, "k1": -0.2, "k2": 0.03, "cx": 110.0}

    k1: float = parameter(0.0, "Coefficient of a^2, with a the angle to the axis.", ge=-1e4, le=1e4)
    k2: float = parameter(0.0, "Coefficient of a^4.", ge=-1e4, le=1e4)
    k3: float = parameter(0.0, "Coefficient of a^6.", ge=-1e4, le=1e4)
    k4: float = parameter(0.0, "Coefficient of a^8.", ge=-1e4, le=1e4)

    def coefficients(self) -> tuple[float, ...]:
        return self.k1, self.k2, self.k3, self.k4


class Unified(PixelFocalLengths):
    """The enhanced unified camera model, EUCM (Khomutenko, Garcia and Martinet, RA-L 2016).

    With beta = 1 it is the unified model of Geyer and Daniilidis, with xi = alpha / (1 - alpha).
    """

    method: ClassVar = "unified"
    summary: ClassVar = "the enhanced unified camera model (EUCM)"
    example: ClassVar = {**EXAMPLE, "fx": 380.0, "alpha": 0.6, "beta": 1.1, "field_of_view": 190.0}

    alpha: float = parameter(0.6, "Projection parameter; 0 is a perspective view.", ge=0, le=1)
    beta: float = parameter(1.0, "Coefficient of the squared distance from the axis.", gt=0, le=100)

    def coefficients(self) -> tuple[float, ...]:
        return self.alpha, self.beta


class DoubleSphere(PixelFocalLengths):
    """The double-sphere camera model (Usenko, Demmel and Cremers, 3DV 2018)."""

    method: ClassVar = "double_sphere"
    summary: ClassVar = "the double-sphere camera model"
    example: ClassVar = {**EXAMPLE, "fx": 380.0, "xi": -0.2, "alpha": 0.59}

    xi: float = parameter(-0.2, "Distance between the centres of the two spheres.", ge=-1, le=2)
    alpha: float = parameter(
        0.6, "Shift of the pinhole from the centre of the second sphere.", ge=0, le=1
    )

    def coefficients(self) -> tuple[float, ...]:
        return self.xi, self.alpha


class FTheta(WideAngle):
    """r = k1 a + k2 a^2 + k3 a^3 + k4 a^4 + k5 a^5 in px, where a is the angle in radians.

    NVIDIA's F-theta model by its polynomial from angles to pixels.
    """

    method: ClassVar = "f_theta"
    summary: ClassVar = "NVIDIA's F-theta model: a polynomial from the angle in radians to px"
    example: ClassVar = {**EXAMPLE, "k1": 380.0, "k2": -1.5, "k3": 2.0, "filter": "lanczos3"}

    k1: float | None = parameter(
        None, "Coefficient of the angle a.", "px", "none: you must set it", gt=0, le=1e7
    )
    k2: float = parameter(0.0, "Coefficient of a^2.", "px", ge=-1e7, le=1e7)
    k3: float = parameter(0.0, "Coefficient of a^3.", "px", ge=-1e7, le=1e7)
    k4: float = parameter(0.0, "Coefficient of a^4.", "px", ge=-1e7, le=1e7)
    k5: float = parameter(0.0, "Coefficient of a^5.", "px", ge=-1e7, le=1e7)

    def resolve(self, context: Context) -> Self:
        """Return the method with the properties of the render.

        Raises:
            RequestError: there is no k1.
        """
        if not self.k1:
            raise RequestError(
                "projection.k1: f_theta needs this parameter; set it to the focal length "
                "in px per radian"
            )
        return super().resolve(context)

    def lens(self) -> WideLens:
        assert self.k1
        return self._lens((self.k1, self.k2, self.k3, self.k4, self.k5), 1.0, 1.0)


METHODS: tuple[type[Method], ...] = (
    NoProjection,
    KannalaBrandt,
    Unified,
    DoubleSphere,
    FTheta,
)

STAGE = rgb_stage(
    "projection",
    "Make a wide-angle image from a render of the whole surroundings.",
    METHODS,
    role=StageRole.VIEW,
)
