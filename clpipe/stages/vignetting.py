"""Vignetting: light falls off towards the corners of the picture."""

from typing import Annotated, ClassVar, Self

import numpy as np
from pydantic import Field

from clpipe.base.types import Floats
from clpipe.camera.lens import LensCalibration
from clpipe.reference.math import inverse_root
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
    StageRole,
    Unchanged,
    parameter,
    rgb_stage,
)

Coefficient = Annotated[float, Field(ge=-100, le=100)]


class NoVignetting(Unchanged):
    """No vignetting."""

    summary: ClassVar = "no vignetting"


class LensVignetting(LensMethod):
    """Vignetting of the lens that ``--lens`` names, at the camera's f-number."""

    summary: ClassVar = (
        "vignetting of the lens that --lens names, at --aperture; none without these"
    )

    def for_lens(self, lens: LensCalibration | None) -> Method:
        if lens is None or not lens.vignetting:
            return NoVignetting()
        table = dict(lens.vignetting)
        return STAGE.by_name[table.pop("method")](**table)


class Pa(Method):
    """v * (1 + k1 r^2 + k2 r^4 + k3 r^6), with r = 1 at the corner pixel: lensfun's pa.

    The coefficients describe the lens itself, like lensfun's calibrations, so k1 is usually
    negative. lensfun divides by this factor to correct an image. Light is never below 0.

    >>> from clpipe.stage import run_reference
    >>> row = run_reference(Pa(k1=-0.5), np.ones((3, 3, 3), np.float32))[1, :, 0]
    >>> [round(float(v), 3) for v in row]
    [0.75, 1.0, 0.75]
    """

    method: ClassVar = "pa"
    kernel: ClassVar = "vignetting"
    summary: ClassVar = "lensfun's pa: 1 + k1 r^2 + k2 r^4 + k3 r^6"
    example: ClassVar = {"k1": -0.5, "k2": 0.1, "k3": -0.2}

    k1: Coefficient = parameter(0.0, "Coefficient of r^2; below 0, the corners are darker.")
    k2: Coefficient = parameter(0.0, "Coefficient of r^4.")
    k3: Coefficient = parameter(0.0, "Coefficient of r^6.")

    def passes(self) -> tuple[Pass, ...]:
        if self.k1 == self.k2 == self.k3 == 0:
            return ()
        return (Pass("vignetting_pa", arguments=("extent", "k1", "k2", "k3")),)

    def reference(self, image: Floats, inputs: ReferenceContext) -> Floats:
        r2 = relative_radius(image)
        k1, k2, k3 = map(np.float32, (self.k1, self.k2, self.k3))
        gain = ((r2 * k3 + k2) * r2 + k1) * r2 + np.float32(1)
        return image * np.maximum(gain, np.float32(0))[..., None]


class CosineFourth(FocalLengthMethod, PrincipalPointMethod):
    """v * cos^4 of the angle to the optical axis, which passes through the principal point.

    This is the illumination of a sensor by a lens without vignetting of its own. With r in focal
    lengths, cos^4 is 1 / (1 + r^2)^2 (Reiss, "The cos^4 law of illumination", J. Opt. Soc. Am.
    1945).

    >>> from clpipe.stage import run_reference
    >>> white = np.ones((1, 5, 3), np.float32)
    >>> run_reference(CosineFourth(fx=2.0), white)[0, :, 0].round(3).tolist()
    [0.25, 0.6399999856948853, 1.0, 0.6399999856948853, 0.25]
    """

    method: ClassVar = "cosine_fourth"
    kernel: ClassVar = "vignetting"
    summary: ClassVar = "the fourth power of the cosine of the angle to the axis"
    example: ClassVar = {"fx": 40.0}
    other_examples: ClassVar = (
        {"fx": None, "focal_length": 20.0, "sensor_width": 36.0},
        {"cx": 12.3, "cy": 9.0},
    )

    def resolve(self, context: Context) -> Self:
        """Return the method with the camera's focal length and principal point.

        Raises:
            RequestError: the focal length is not known.
        """
        resolved = self.with_optics(context)
        resolved.check_focal_length("vignetting")
        return resolved

    def passes(self) -> tuple[Pass, ...]:
        names = ("extent", "x", "y", "per_px", "per_side")
        return (Pass("vignetting_cosine", arguments=names),)

    def arguments(self, context: Context) -> Arguments:
        per_px, per_side = self._inverse_focal_squared()
        centre = {"x": _coordinate(self.cx, "width"), "y": _coordinate(self.cy, "height")}
        return {"extent": CompileTime("e"), **centre, "per_px": per_px, "per_side": per_side}

    def _inverse_focal_squared(self) -> tuple[float, float]:
        """Return 1 over the squared focal length in px, or in longer sides; the other one is 0."""
        if self.fx:
            return self.fx**-2, 0.0
        assert self.focal_length and self.sensor_width
        return 0.0, (self.sensor_width / self.focal_length) ** 2

    def reference(self, image: Floats, inputs: ReferenceContext) -> Floats:
        per_px, per_side = map(np.float32, self._inverse_focal_squared())
        side: Floats = np.full(1, max(image.shape[:2]), np.float32)
        unit = per_px or per_side * _reciprocal(side * side)
        cosine = _reciprocal(_squared_radius(image, self.cx, self.cy) * unit + np.float32(1))
        return image * (cosine * cosine)[..., None]


def relative_radius(image: Floats) -> Floats:
    """Return the squared distance of each pixel from the centre, 1 at the corner pixel.

    >>> relative_radius(np.zeros((3, 3, 3), np.float32))[0].astype(float).round(3).tolist()
    [1.0, 0.5, 1.0]
    """
    sides: Floats = np.maximum(np.array(image.shape[:2], np.float32) - 1, 1)
    corner = (sides * sides).sum(keepdims=True) * np.float32(0.25)
    return _squared_radius(image) * _reciprocal(corner)


def _squared_radius(image: Floats, cx: float | None = None, cy: float | None = None) -> Floats:
    """Return the squared distance of each pixel to a point, in px; None is the image centre."""
    height, width = image.shape[:2]
    centres = (width, width / 2 if cx is None else cx), (height, height / 2 if cy is None else cy)
    dx, dy = (np.arange(n, dtype=np.float32) + np.float32(0.5) - np.float32(c) for n, c in centres)
    return dx * dx + (dy * dy)[:, None]


def _coordinate(centre: float | None, side: str) -> float | CompileTime:
    """Return a coordinate of the principal point; None is the centre, which a kernel computes."""
    return CompileTime(f"0.5f * (float)e.{side}") if centre is None else centre


def _reciprocal(x: Floats) -> Floats:
    root = inverse_root(x)
    return root * root


STAGE = rgb_stage(
    "vignetting",
    "Darken the corners of the image, like a lens.",
    (LensVignetting, NoVignetting, Pa, CosineFourth),
    role=StageRole.FALLOFF,
)
