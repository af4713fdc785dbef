"""A picture's intrinsics: focal lengths, principal point and distortion, as COLMAP counts them.

The first pixel's centre is at (0.5, 0.5); OpenCV's cx and cy are smaller by 0.5.
"""

import math
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from types import MappingProxyType
from typing import Any

from clpipe.base.errors import RequestError

PINHOLE, OPENCV, FULL_OPENCV = "PINHOLE", "OPENCV", "FULL_OPENCV"
OPENCV_FISHEYE = "OPENCV_FISHEYE"
COEFFICIENTS = {
    PINHOLE: (),
    OPENCV: ("k1", "k2", "p1", "p2"),
    FULL_OPENCV: ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6"),
    OPENCV_FISHEYE: ("k1", "k2", "k3", "k4"),
}

AGREEMENT = 0.01  # of focal lengths; those in mm are often rounded


@dataclass(frozen=True)
class Intrinsics:
    """The camera of a picture, by COLMAP's models.

    Args:
        width, height: of the picture, in px.
        fx, fy: focal lengths in px.
        cx, cy: the principal point in px from the upper left corner.
        model: of :data:`COEFFICIENTS`.
        distortion: the coefficients by their names; those of green where colours part.
        residual: by how far points may be elsewhere, in px, where the model is fitted to a lens.
    """

    width: int
    height: int
    fx: float
    fy: float
    cx: float
    cy: float
    model: str = PINHOLE
    distortion: Mapping[str, float] = field(default_factory=dict)
    residual: float = 0.0

    @classmethod
    def of_render(
        cls,
        width: int,
        height: int,
        shot: Mapping[str, float],
        places: Mapping[str, str] = MappingProxyType({}),
    ) -> "Intrinsics | None":
        """The intrinsics of a render, undistorted; None where its focal length is not known.

        Args:
            width, height: in px.
            shot: what is known: fx, fy, cx, cy in px, or focal_length and sensor_width in mm, the
                latter along the longer side, or pixel_pitch in um, or camera_angle_x in radians.
            places: where it is stated, for the message.

        Raises:
            RequestError: the focal length is known in several ways, which contradict each other.

        >>> Intrinsics.of_render(400, 300, {"focal_length": 50.0, "sensor_width": 40.0}).fx
        500.0
        """
        said = {name: places.get(name, name) for name in shot}
        found = {said["fx"]: shot["fx"]} if "fx" in shot else {}
        if "camera_angle_x" in shot:
            found[said["camera_angle_x"]] = width / 2 / math.tan(shot["camera_angle_x"] / 2)
        pitches = {}
        if "sensor_width" in shot:
            pitches["sensor_width"] = shot["sensor_width"] / max(width, height)
        if "pixel_pitch" in shot:
            pitches["pixel_pitch"] = shot["pixel_pitch"] / 1000
        for name, pitch in pitches.items() if "focal_length" in shot else ():
            found[f"{said['focal_length']} and {said[name]}"] = shot["focal_length"] / pitch
        if not found:
            return None
        (first, fx), *others = found.items()
        for other, length in others:
            if abs(length - fx) > AGREEMENT * fx:
                raise RequestError(
                    f"{first} makes the focal length of this render of {width}x{height} pixels "
                    f"{fx:g} px, but {other} {length:g} px; correct one, or leave it out"
                )
        cx, cy = shot.get("cx", width / 2), shot.get("cy", height / 2)
        return cls(width, height, fx, shot.get("fy", fx), cx, cy)

    def scaled(self, width: int, height: int) -> "Intrinsics":
        """The intrinsics of the picture made another size, its edges staying where they are."""
        x, y = width / self.width, height / self.height
        places = self.fx * x, self.fy * y, self.cx * x, self.cy * y
        residual = self.residual * max(x, y)
        return Intrinsics(width, height, *places, self.model, self.distortion, residual)

    def record(self) -> dict[str, Any]:
        """Intrinsics as JSON values; coefficients that are not given are 0."""
        names = COEFFICIENTS[self.model]
        return {**asdict(self), "distortion": {n: self.distortion.get(n, 0.0) for n in names}}
