"""A picture's intrinsics: focal lengths, principal point and distortion, as COLMAP counts them.

The first pixel's centre is at (0.5, 0.5); OpenCV's cx and cy are smaller by 0.5.
"""

from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from typing import Any

PINHOLE, FULL_OPENCV, OPENCV_FISHEYE = "PINHOLE", "FULL_OPENCV", "OPENCV_FISHEYE"
COEFFICIENTS = {
    PINHOLE: (),
    FULL_OPENCV: ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6"),
    OPENCV_FISHEYE: ("k1", "k2", "k3", "k4"),
}


@dataclass(frozen=True)
class Intrinsics:
    """The camera of a picture, by COLMAP's models.

    Args:
        width, height: of the picture, in px.
        fx, fy: focal lengths in px.
        cx, cy: the principal point in px from the upper left corner.
        model: of :data:`COEFFICIENTS`.
        distortion: the coefficients by their names; those of green where colours part.
    """

    width: int
    height: int
    fx: float
    fy: float
    cx: float
    cy: float
    model: str = PINHOLE
    distortion: Mapping[str, float] = field(default_factory=dict)

    @classmethod
    def of_render(cls, width: int, height: int, shot: Mapping[str, float]) -> "Intrinsics | None":
        """Those of a render, which has no distortion; None where its focal length is not known.

        Args:
            width, height: in px.
            shot: what is known: fx, fy, cx, cy in px, or focal_length and sensor_width in mm, the
                latter along the longer side.

        >>> Intrinsics.of_render(400, 300, {"focal_length": 50.0, "sensor_width": 40.0}).fx
        500.0
        """
        fx = shot.get("fx")
        if fx is None and {"focal_length", "sensor_width"} <= shot.keys():
            fx = shot["focal_length"] / shot["sensor_width"] * max(width, height)
        if fx is None:
            return None
        cx, cy = shot.get("cx", width / 2), shot.get("cy", height / 2)
        return cls(width, height, fx, shot.get("fy", fx), cx, cy)

    def scaled(self, width: int, height: int) -> "Intrinsics":
        """Those of the picture made another size, its edges staying where they are."""
        x, y = width / self.width, height / self.height
        places = self.fx * x, self.fy * y, self.cx * x, self.cy * y
        return Intrinsics(width, height, *places, self.model, self.distortion)

    def record(self) -> dict[str, Any]:
        """All of them as JSON values; coefficients that are not given are 0."""
        names = COEFFICIENTS[self.model]
        return {**asdict(self), "distortion": {n: self.distortion.get(n, 0.0) for n in names}}
