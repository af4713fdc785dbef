"""An image's intrinsics: focal lengths, principal point and distortion, in COLMAP's convention.

The first pixel's centre is at (0.5, 0.5); OpenCV's cx and cy are smaller by 0.5.
"""

import math
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field, replace
from types import MappingProxyType
from typing import Any

import numpy as np

from clpipe.base.errors import RequestError
from clpipe.base.types import Array

PINHOLE, OPENCV, FULL_OPENCV = "PINHOLE", "OPENCV", "FULL_OPENCV"
OPENCV_FISHEYE = "OPENCV_FISHEYE"
POLYNOMIAL = "POLYNOMIAL"  # not a model of COLMAP
THIN_PRISM = "OPENCV_THIN_PRISM"  # OpenCV's 12 coefficients, also not a model of COLMAP
DECENTRING = ("p1", "p2", "s1", "s2", "s3", "s4")  # coefficients that are not radial
COEFFICIENTS = {
    PINHOLE: (),
    OPENCV: ("k1", "k2", "p1", "p2"),
    FULL_OPENCV: ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6"),
    THIN_PRISM: ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6", "s1", "s2", "s3", "s4"),
    OPENCV_FISHEYE: ("k1", "k2", "k3", "k4"),
}

LAWSON_ITERATIONS = 40  # iterations of a fit

FOCAL_TOLERANCE = 0.01  # relative error of a focal length; values in mm are often rounded


@dataclass(frozen=True)
class Intrinsics:
    """The camera of an image, by COLMAP's models.

    Args:
        width, height: of the image, in px.
        fx, fy: focal lengths in px.
        cx, cy: the principal point in px from the upper left corner.
        model: a key of :data:`COEFFICIENTS`.
        distortion: the coefficients by name, for green if there is lateral colour.
        residual: the largest position error in px of a model that is fitted to a lens.
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
        """Return the intrinsics of a render, undistorted; None if its focal length is not known.

        Args:
            width: the width of the render in px.
            height: its height in px.
            shot: known values: fx, fy, cx, cy in px; focal_length and sensor_width in mm, along the
                longer side; pixel_pitch in um; camera_angle_x in radians.
            places: where each value is stated, for the message.

        Raises:
            RequestError: stated focal lengths contradict each other.

        >>> Intrinsics.of_render(400, 300, {"focal_length": 50.0, "sensor_width": 40.0}).fx
        500.0
        """
        labels = {name: places.get(name, name) for name in shot}
        focal_lengths = {labels["fx"]: shot["fx"]} if "fx" in shot else {}
        if "camera_angle_x" in shot:
            focal_lengths[labels["camera_angle_x"]] = (
                width / 2 / math.tan(shot["camera_angle_x"] / 2)
            )
        pitches = {}
        if "sensor_width" in shot:
            pitches["sensor_width"] = shot["sensor_width"] / max(width, height)
        if "pixel_pitch" in shot:
            pitches["pixel_pitch"] = shot["pixel_pitch"] / 1000
        for name, pitch in pitches.items() if "focal_length" in shot else ():
            focal_lengths[f"{labels['focal_length']} and {labels[name]}"] = (
                shot["focal_length"] / pitch
            )
        if not focal_lengths:
            return None
        (first, fx), *others = focal_lengths.items()
        for other, length in others:
            if abs(length - fx) > FOCAL_TOLERANCE * fx:
                raise RequestError(
                    f"{first} makes the focal length of this render of {width}x{height} pixels "
                    f"{fx:g} px, but {other} {length:g} px; correct or remove one"
                )
        cx, cy = shot.get("cx", width / 2), shot.get("cy", height / 2)
        return cls(width, height, fx, shot.get("fy", fx), cx, cy)

    def scaled(self, width: int, height: int, shown: tuple[int, int]) -> "Intrinsics":
        """Return the intrinsics of the resized image.

        Args:
            width: the width of the result in px.
            height: its height in px.
            shown: the columns and rows that it shows, from the upper left corner.
        """
        x, y = width / shown[0], height / shown[1]
        parameters = self.fx * x, self.fy * y, self.cx * x, self.cy * y
        residual = self.residual * max(x, y)
        return Intrinsics(width, height, *parameters, self.model, self.distortion, residual)

    def polynomial(self) -> "Intrinsics":
        """Return the same camera by the model of :data:`POLYNOMIAL`, fitted if necessary.

        The radial factor is then ``1 + k1 r^2 + k2 r^4 + k3 r^6 + k4 r^8``, like in nerfstudio, and
        the focal length is adjusted. ``residual`` is the largest error of the fit in the image.
        """
        coefficients = self.distortion
        denominator = [coefficients.get(f"k{i}", 0.0) for i in (4, 5, 6)]
        named = {name: coefficients.get(name, 0.0) for name in ("k1", "k2", "k3", "p1", "p2")}
        if not any(denominator):
            return replace(self, model=POLYNOMIAL, distortion={**named, "k4": 0.0})
        numerator = [named[f"k{i}"] for i in (1, 2, 3)]

        def distorted(r: Array) -> Array:
            powers = np.stack([r**2, r**4, r**6])
            return np.asarray(r * (1 + numerator @ powers) / (1 + denominator @ powers))

        corners = [(x - self.cx) / self.fx for x in (0, self.width)]
        heights = [(y - self.cy) / self.fy for y in (0, self.height)]
        corner = max(math.hypot(x, y) for x in corners for y in heights)
        r = np.linspace(0, 4 * corner, 4096)
        radii = distorted(r)
        rising = np.flatnonzero(np.diff(radii) <= 0)
        last = rising[0] + 1 if rising.size else len(r)
        shown = np.linspace(0, 1, 512)[1:] * min(corner, radii[:last].max())
        r = np.interp(shown, radii[:last], r[:last])
        first, *k, error = minimax_fit(np.stack([r, r**3, r**5, r**7, r**9], 1), distorted(r))
        fitted = {f"k{i}": c / first for i, c in enumerate(k, 1)}
        tangential = {name: named[name] / first for name in ("p1", "p2")}
        residual = self.residual + error * max(self.fx, self.fy)
        return replace(
            self,
            fx=self.fx * first,
            fy=self.fy * first,
            model=POLYNOMIAL,
            distortion={**fitted, **tangential},
            residual=residual,
        )

    def record(self) -> dict[str, Any]:
        """Return intrinsics as JSON values; missing coefficients are 0."""
        names = COEFFICIENTS[self.model]
        return {**asdict(self), "distortion": {n: self.distortion.get(n, 0.0) for n in names}}


def minimax_fit(terms: Array, values: Array) -> list[float]:
    """Return the factors of terms, (place, term), that fit values best, and their largest error.

    Least squares with weights that grow where the error is large (Lawson, 1961).
    """
    scale = abs(terms).max(0)
    weights = np.ones(len(values))
    best: tuple[float, Array] = np.inf, np.zeros(len(scale))
    for _ in range(LAWSON_ITERATIONS):
        root = np.sqrt(weights)[:, None]
        found, *_ = np.linalg.lstsq(terms / scale * root, values * root[:, 0], rcond=None)
        error = abs(terms / scale @ found - values)
        best = min(best, (float(error.max()), found), key=lambda each: each[0])
        if not error.any():
            break
        weights = weights * (error / error.mean() + 1e-9)
        weights /= weights.sum()
    return [*map(float, best[1] / scale), best[0]]
