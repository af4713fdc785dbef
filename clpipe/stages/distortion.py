"""Lens distortion with lateral colour: straight lines bend, and red and blue shift from green.

The render has no distortion, and the finished image has it. For each pixel of the image,
:mod:`clpipe.reference.lens` inverts the model to find the position in the render.
:mod:`clpipe.reference.warp` then samples each channel there in one resampling. Positions outside
the frame are sampled too if the render has overscan (:mod:`clpipe.chain.overscan`). Lateral colour
and lensfun's models are those of lensfun (lensfun.github.io, "Lens correction models"). Their r = 1
is half the short side of the image, between the centres of the outermost pixels.
"""

from collections.abc import Mapping
from dataclasses import replace
from typing import Annotated, ClassVar, Literal, Self

from pydantic import Field

from clpipe.base.types import Floats
from clpipe.camera.lens import LensCalibration
from clpipe.reference import warp
from clpipe.reference.lens import DistortionMap
from clpipe.reference.radial import Radial
from clpipe.stage import (
    Arguments,
    CompileTime,
    Context,
    FocalLengthMethod,
    LensMethod,
    Method,
    Pass,
    PrincipalPointMethod,
    ReferenceContext,
    Resample,
    StageRole,
    Unchanged,
    parameter,
    rgb_stage,
)


class NoDistortion(Unchanged):
    """No distortion."""

    summary: ClassVar = "no distortion"


def filter_arguments(name: str) -> Arguments:
    """Return the kernel's arguments for the filter of this name."""
    filter_ = warp.FILTERS[name]
    taps, powers = filter_.shape
    return {
        "filter": filter_,
        "taps": CompileTime(str(taps)),
        "powers": CompileTime(str(powers)),
    }


class WarpMethod(PrincipalPointMethod):
    """Parameters that every lens model has."""

    fit: bool = parameter(
        False, "Scale the image to show as much of the render as possible without void pixels."
    )
    filter: Literal["bicubic", "lanczos3"] = parameter(
        "bicubic",
        "Resampling filter: bicubic (Catmull-Rom), or lanczos3, which is sharper and rings.",
        structural=True,
    )


class LensDistortion(LensMethod, WarpMethod):
    """Distortion of the lens that ``--lens`` names, from lensfun; without it, none."""

    summary: ClassVar = "distortion of the lens that --lens names; none without it"

    def for_lens(self, lens: LensCalibration | None) -> Method:
        if lens is None or not lens.distortion:
            return NoDistortion()
        parameters, table = dict(self), dict(lens.distortion)
        return STAGE.by_name[table.pop("method")](**parameters, **table)


class Distortion(WarpMethod):
    """A lens's distortion and lateral colour, in one resampling."""

    kernel: ClassVar = "distortion"
    overscan: ClassVar = True

    kr: float = parameter(
        1.0, "Lateral colour, linear: size of red relative to green.", gt=0.5, lt=2
    )
    kb: float = parameter(
        1.0, "Lateral colour, linear: size of blue relative to green.", gt=0.5, lt=2
    )
    vr: float = parameter(1.0, "Lateral colour, poly3, red: r (vr + cr r + br r^2).", gt=0.5, lt=2)
    cr: float = parameter(0.0, "See vr.", ge=-1, le=1)
    br: float = parameter(0.0, "See vr.", ge=-1, le=1)
    vb: float = parameter(1.0, "Lateral colour, poly3, blue: r (vb + cb r + bb r^2).", gt=0.5, lt=2)
    cb: float = parameter(0.0, "See vb.", ge=-1, le=1)
    bb: float = parameter(0.0, "See vb.", ge=-1, le=1)

    def radial(self) -> Radial:
        """The lens model."""
        raise NotImplementedError(type(self).__name__)

    def lens(self) -> DistortionMap:
        """The map from pixels to positions in the render, for all channels."""
        return DistortionMap(
            radial=self.radial(),
            centre=(self.cx, self.cy),
            red=Radial.of(self.kr * self.vr, self.kr * self.cr, self.kr * self.br),
            blue=Radial.of(self.kb * self.vb, self.kb * self.cb, self.kb * self.bb),
            fit=self.fit,
            margins=self.margins,
        )

    @property
    def resampling(self) -> warp.Warp:
        """The geometry from render to image."""
        return warp.Warp(self.lens(), self.filter)

    def passes(self) -> tuple[Pass, ...]:
        resampling = self.resampling
        if resampling.lens.is_identity:
            return ()
        access = Resample(resampling, resampling.support)
        return (Pass("distortion", access, ("filter", "taps", "powers")),)

    def geometry(self) -> DistortionMap | None:
        return self.lens() if self.passes() else None

    def estimates_for(self, width: int, height: int) -> Mapping[str, float]:
        """Return the factor by which ``fit`` changes the focal length."""
        return {"focal_length_factor": self.lens().scale(width, height)} if self.fit else {}

    def arguments(self, context: Context) -> Arguments:
        return filter_arguments(self.filter)

    def reference(self, image: Floats, inputs: ReferenceContext) -> Floats:
        return self.resampling.reference(image) if self.passes() else image


Coefficient = Annotated[float, Field(ge=-1e4, le=1e4)]


class FocalLengthDistortion(FocalLengthMethod, Distortion):
    """A model that is defined in focal lengths."""

    fy: float | None = parameter(
        None, "Vertical focal length.", "px", "fx", optics=True, gt=0, le=1e7
    )

    def resolve(self, context: Context) -> Self:
        """Return the method with the camera's focal length.

        Raises:
            RequestError: it is not known.
        """
        resolved = self.with_optics(context)
        resolved.check_focal_length("distortion")
        return resolved.with_defaults(fy=resolved.fx)

    def estimates_for(self, width: int, height: int) -> Mapping[str, float]:
        """Return the factor by which ``fit`` changes the focal length, and the result in px."""
        estimates = super().estimates_for(width, height)
        if not estimates:
            return estimates
        lens = self.lens()
        unit = lens.unit(*lens.size(width, height))
        fx, fy = (estimates["focal_length_factor"] * each for each in unit)
        return {**estimates, "fx": fx, "fy": fy}

    def lens(self) -> DistortionMap:
        lens = super().lens()
        if self.fx and self.fy:
            return replace(lens, focal=(self.fx, self.fy))
        return replace(lens, relative_focal_length=self.relative_focal_length)


class BrownConrady(FocalLengthDistortion):
    """x_d = x R(r) + 2 p1 x y + p2 (r^2 + 2 x^2), y_d likewise: OpenCV's and COLMAP's model.

    The radial factor is ``R = (1 + k1 r^2 + k2 r^4 + k3 r^6) / (1 + k4 r^2 + k5 r^4 + k6 r^6)``. x
    and y start at the principal point and are in focal lengths (Brown, "Decentering distortion of
    lenses", 1966; OpenCV, "Camera calibration and 3D reconstruction"). A thin prism adds
    ``s1 r^2 + s2 r^4`` to x_d, and ``s3 r^2 + s4 r^4`` to y_d (Weng et al., PAMI 1992).

    >>> import numpy as np
    >>> lens = BrownConrady(fx=100.0, fy=100.0, k1=-0.1).lens()
    >>> x, y = lens.origins(np.array(148.75), np.array(100.0), 200, 200)
    >>> round(float(x), 6), float(y)
    (150.0, 100.0)
    """

    method: ClassVar = "brown_conrady"
    summary: ClassVar = (
        "model of OpenCV: radial k1 to k6, tangential p1 and p2, thin prism s1 to s4"
    )
    example: ClassVar = {
        **{"focal_length": 20.0, "sensor_width": 24.0, "k1": -0.2, "k4": 0.05, "p1": 0.002},
        **{"p2": -0.003, "s1": 0.002, "s4": -0.004, "vr": 1.01, "bb": 0.01},
    }

    k1: Coefficient = parameter(0.0, "Radial coefficient of r^2.")
    k2: Coefficient = parameter(0.0, "Radial coefficient of r^4.")
    k3: Coefficient = parameter(0.0, "Radial coefficient of r^6.")
    k4: Coefficient = parameter(0.0, "Radial coefficient of r^2 in the denominator.")
    k5: Coefficient = parameter(0.0, "Radial coefficient of r^4 in the denominator.")
    k6: Coefficient = parameter(0.0, "Radial coefficient of r^6 in the denominator.")
    p1: Coefficient = parameter(0.0, "Tangential coefficient, vertical.")
    p2: Coefficient = parameter(0.0, "Tangential coefficient, horizontal.")
    s1: Coefficient = parameter(0.0, "Thin prism, horizontal coefficient of r^2.")
    s2: Coefficient = parameter(0.0, "Thin prism, horizontal coefficient of r^4.")
    s3: Coefficient = parameter(0.0, "Thin prism, vertical coefficient of r^2.")
    s4: Coefficient = parameter(0.0, "Thin prism, vertical coefficient of r^4.")

    def radial(self) -> Radial:
        denominator = (0.0, self.k4, 0.0, self.k5, 0.0, self.k6)
        return Radial.of(1.0, 0.0, self.k1, 0.0, self.k2, 0.0, self.k3, denominator=denominator)

    def lens(self) -> DistortionMap:
        prism = self.s1, self.s2, self.s3, self.s4
        return replace(super().lens(), tangential=(self.p1, self.p2), prism=prism)


class Fisheye(FocalLengthDistortion):
    """r_d = a (1 + k1 a^2 + k2 a^4 + k3 a^6 + k4 a^8), a = atan(r): OpenCV's fisheye model.

    r starts at the principal point and is in focal lengths (Kannala and Brandt, PAMI 2006; COLMAP
    calls it OPENCV_FISHEYE). Pixels outside the render's field of view and overscan are black.
    """

    method: ClassVar = "fisheye"
    summary: ClassVar = "OpenCV's fisheye model: a polynomial of the angle to the axis"
    example: ClassVar = {
        **{"fx": 300.0, "fy": 330.0, "k1": -0.02, "k2": 0.003, "cx": 20.0, "kr": 0.995}
    }

    k1: Coefficient = parameter(0.0, "Coefficient of a^2, with a the angle to the axis.")
    k2: Coefficient = parameter(0.0, "Coefficient of a^4.")
    k3: Coefficient = parameter(0.0, "Coefficient of a^6.")
    k4: Coefficient = parameter(0.0, "Coefficient of a^8.")

    def radial(self) -> Radial:
        powers = (1.0, 0.0, self.k1, 0.0, self.k2, 0.0, self.k3, 0.0, self.k4)
        return Radial.of(*powers, of_angle=True)


class LensfunDistortion(Distortion):
    """A model of lensfun, in the units of lensfun's lateral colour."""

    unit: float | None = parameter(
        None,
        "Radius of r = 1, in half diagonals of the image, if it is not half the short side.",
        gt=0.01,
        le=100,
    )

    def lens(self) -> DistortionMap:
        return replace(super().lens(), half_diagonals=self.unit)


class Poly3(LensfunDistortion):
    """r_d = r (1 - k1 + k1 r^2), lensfun's model of that name."""

    method: ClassVar = "poly3"
    summary: ClassVar = "lensfun's poly3: r (1 - k1 + k1 r^2)"
    example: ClassVar = {"k1": 0.02, "kr": 1.002, "kb": 0.998, "fit": True}

    k1: Coefficient = parameter(0.0, "Positive for pincushion, negative for barrel distortion.")

    def radial(self) -> Radial:
        return Radial.of(1 - self.k1, 0.0, self.k1)


class Poly5(LensfunDistortion):
    """r_d = r (1 + k1 r^2 + k2 r^4), lensfun's model of that name."""

    method: ClassVar = "poly5"
    summary: ClassVar = "lensfun's poly5: r (1 + k1 r^2 + k2 r^4)"
    example: ClassVar = {"k1": 0.03, "k2": 0.001}

    k1: Coefficient = parameter(0.0, "Coefficient of r^2.")
    k2: Coefficient = parameter(0.0, "Coefficient of r^4.")

    def radial(self) -> Radial:
        return Radial.of(1.0, 0.0, self.k1, 0.0, self.k2)


class PtLens(LensfunDistortion):
    """r_d = r (a r^3 + b r^2 + c r + 1 - a - b - c), lensfun's and Hugin's model of that name."""

    method: ClassVar = "ptlens"
    summary: ClassVar = "ptlens of lensfun and Hugin: r (a r^3 + b r^2 + c r + 1 - a - b - c)"
    example: ClassVar = {"a": 0.001, "b": 0.01, "c": 0.02, "cy": 20.0}

    a: Coefficient = parameter(0.0, "Coefficient of r^3.")
    b: Coefficient = parameter(0.0, "Coefficient of r^2.")
    c: Coefficient = parameter(0.0, "Coefficient of r.")

    def radial(self) -> Radial:
        return Radial.of(1 - self.a - self.b - self.c, self.c, self.b, self.a)


STAGE = rgb_stage(
    "distortion",
    "Apply a lens's distortion and lateral colour.",
    (LensDistortion, NoDistortion, BrownConrady, Fisheye, Poly3, Poly5, PtLens),
    role=StageRole.LENS,
)
