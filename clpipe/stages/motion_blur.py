"""Motion blur of a camera that moves during the exposure."""

from functools import lru_cache
from typing import ClassVar, Self

import numpy as np
from pydantic import model_validator

from clpipe.base.errors import RequestError
from clpipe.base.types import Floats
from clpipe.reference.convolve import convolve, tap_radius, taps_of
from clpipe.reference.turning import BILINEAR, CameraRotation
from clpipe.stage import (
    Arguments,
    Context,
    FocalLengthMethod,
    Method,
    Pass,
    PrincipalPointMethod,
    ReferenceContext,
    Resample,
    StageRole,
    Stencil,
    optics_parameter,
    parameter,
    pure,
    rgb_stage,
)

MAX_LENGTH = 200.0  # px; the longest streak
TAPS_PER_PIXEL = 64  # kernel taps per pixel of a streak's length


@pure
@lru_cache(maxsize=64)
def streak(length: float, angle: float) -> Floats:
    """Return the taps of a straight streak with the same light along its length.

    Each tap is distributed bilinearly to the four surrounding pixels.

    Args:
        length: px, above 0.
        angle: degrees, from right towards up.

    >>> streak(2.0, 0.0)[:, 2].round(3).tolist()
    [0.25, 0.5, 0.25]
    """
    count = int(np.ceil(length * TAPS_PER_PIXEL))
    along = ((np.arange(count) + 0.5) / count - 0.5) * length
    x, y = along * np.cos(np.deg2rad(angle)), -along * np.sin(np.deg2rad(angle))
    reach = int(np.ceil(length / 2)) + 1
    image = np.zeros((2 * reach + 1, 2 * reach + 1))
    for dx in (0, 1):
        for dy in (0, 1):
            columns, rows = np.floor(x).astype(int) + dx, np.floor(y).astype(int) + dy
            weight = (1 - abs(x - columns)) * (1 - abs(y - rows))
            np.add.at(image, (rows + reach, columns + reach), weight)
    return taps_of(image[..., None].repeat(3, 2) / count)


class Linear(Method):
    """A straight streak, the same everywhere, from a small rotation of the camera.

    The camera rotates evenly about an axis in the image plane. Away from the centre, a real streak
    bends and is longer by 1 / cos^2 of the angle to the optical axis. This method ignores both,
    like SyB3R's "linear blur" (Ley, Hänsch and Hellwich, ICCV Workshops 2017). ``perspective``
    includes them.

    >>> from clpipe.stage import run_reference
    >>> dot = np.zeros((1, 7, 3), np.float32)
    >>> dot[0, 3] = 1
    >>> run_reference(Linear(length=3.0), dot)[0, :, 0].astype(float).round(2).tolist()
    [0.0, 0.04, 0.29, 0.33, 0.29, 0.04, 0.0]
    """

    method: ClassVar = "linear"
    kernel: ClassVar = "convolve"
    overscan: ClassVar = True
    summary: ClassVar = "a straight streak, the same everywhere"
    example: ClassVar = {"length": 5.3, "angle": 30.0}
    alternatives: ClassVar = frozenset({"length", "rotation"})

    length: float | None = parameter(
        None,
        "Length of the streak; 0 disables it.",
        "px",
        "from rotation, else 0",
        ge=0,
        le=MAX_LENGTH,
    )
    angle: float = parameter(
        0.0, "Direction of the streak, from right towards up.", "degrees", ge=-360, le=360
    )
    rotation: float | None = parameter(
        None,
        "Rotation of the camera during the exposure; set it instead of length.",
        "degrees",
        "none",
        ge=0,
        lt=45,
    )
    fx: float | None = optics_parameter(
        "Focal length, for the streak of a rotation.", "px", gt=0, le=1e6
    )

    @model_validator(mode="after")
    def _check_length(self) -> "Linear":
        if self.length is not None and self.rotation is not None:
            raise ValueError("set either length or rotation: both define the length of the streak")
        return self

    def resolve(self, context: Context) -> Self:
        """Return the method with a length: f tan(rotation), in the middle of the image.

        Raises:
            RequestError: the focal length is not known in px, or the streak is too long.
        """
        resolved = self.with_optics(context)
        if not resolved.rotation:
            return resolved.with_defaults(length=0.0)
        if not resolved.fx:
            raise RequestError(
                "motion_blur: rotation needs a focal length; set fx, in px, here or in render"
            )
        length = float(resolved.fx * np.tan(np.deg2rad(resolved.rotation)))
        if length > MAX_LENGTH:
            raise RequestError(
                f"motion_blur: rotation {resolved.rotation:g} at fx {resolved.fx:g} makes a streak "
                f"of {length:.0f} px; at most {MAX_LENGTH:g} px are allowed, so lower rotation"
            )
        return resolved.model_copy(update={"length": length, "rotation": None})

    @property
    def pixels(self) -> float:
        """The length of the streak in px."""
        return self.length or 0.0

    @property
    def taps(self) -> Floats:
        """See :func:`streak`."""
        return streak(self.pixels, self.angle)

    def passes(self) -> tuple[Pass, ...]:
        if not self.pixels:
            return ()
        radius = tap_radius(self.taps)
        return (Pass("convolve", Stencil(radius), ("taps", "count")),)

    def arguments(self, context: Context) -> Arguments:
        if not self.pixels:
            return {}
        return {"taps": self.taps, "count": len(self.taps)}

    def reference(self, image: Floats, inputs: ReferenceContext) -> Floats:
        return convolve(image, self.taps) if self.pixels else image


class Perspective(FocalLengthMethod, PrincipalPointMethod):
    """Streaks of a rotating camera, with their perspective at each position of the image.

    The camera rotates evenly about an axis in its image plane. It shows the render unchanged in the
    middle of the exposure. Each pixel is the mean of the light it received, from
    :class:`clpipe.reference.turning.CameraRotation`.

    >>> from clpipe.stage import run_reference
    >>> dots = np.zeros((1, 201, 3), np.float32)
    >>> dots[0, [30, 100]] = 1
    >>> rotation_warp = Perspective(rotation=1.6, fx=100.0)
    >>> streaks = run_reference(rotation_warp, dots)[0, :, 0].astype(float)  # 2.8 and 4.2 px long
    >>> streaks[98:103].round(2).tolist(), streaks[28:33].round(2).tolist()
    ([0.03, 0.29, 0.36, 0.29, 0.03], [0.14, 0.24, 0.24, 0.24, 0.13])
    """

    method: ClassVar = "perspective"
    kernel: ClassVar = "motion_blur"
    overscan: ClassVar = True
    summary: ClassVar = "streaks of a rotating camera, longer and bent away from the image centre"
    example: ClassVar = {"rotation": 4.0, "angle": 30.0, "fx": 90.0}
    other_examples: ClassVar = ({"fx": None, "focal_length": 40.0, "sensor_width": 20.0},)

    rotation: float = parameter(
        0.0, "Rotation of the camera during the exposure; 0 disables it.", "degrees", ge=0, lt=45
    )
    angle: float = parameter(
        0.0,
        "Direction in which the middle of the image moves, from right towards up.",
        "degrees",
        ge=-360,
        le=360,
    )

    def resolve(self, context: Context) -> Self:
        """Return the method with the camera's focal length and principal point.

        Raises:
            RequestError: the rotation is not 0, and the focal length is not known.
        """
        resolved = self.with_optics(context)
        if resolved.rotation:
            resolved.check_focal_length("motion_blur")
        return resolved

    @property
    def rotation_warp(self) -> CameraRotation:
        """The geometry from render to image."""
        centre = self.cx, self.cy
        return CameraRotation(
            self.rotation, self.angle, self.fx, self.relative_focal_length, centre, self.margins
        )

    def passes(self) -> tuple[Pass, ...]:
        if not self.rotation:
            return ()
        rotation_warp = self.rotation_warp
        return (Pass("turned", Resample(rotation_warp, 1), ("filter",)),)

    def arguments(self, context: Context) -> Arguments:
        return {"filter": BILINEAR} if self.rotation else {}

    def reference(self, image: Floats, inputs: ReferenceContext) -> Floats:
        return self.rotation_warp.reference(image) if self.rotation else image


STAGE = rgb_stage(
    "motion_blur",
    "Blur by camera motion during the exposure.",
    (Linear, Perspective),
    role=StageRole.LENS,
)
