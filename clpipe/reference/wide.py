"""Wide lenses: the distance from the principal point for a ray at some angle to the axis.

All models are rotationally symmetric and may see more than 180 degrees. The angle to the axis is
theta, and the distance from the principal point, in focal lengths, is r.
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from clpipe.base.errors import ImageError
from clpipe.base.types import Array
from clpipe.reference.geometry import Centre, centre_in
from clpipe.reference.intrinsics import OPENCV_FISHEYE, Intrinsics, minimax_fit

Coefficients = tuple[float, ...]

ANGLES = 1 << 16  # angles of a table from the axis to the edge of the field of view


def kannala_brandt(theta: Array, k: Coefficients) -> Array:
    """r = theta + k1 theta^3 + k2 theta^5 + k3 theta^7 + k4 theta^9: OpenCV's fisheye model.

    Kannala and Brandt, "A generic camera model and calibration method for conventional, wide-angle
    and fish-eye lenses", PAMI 2006.
    """
    square = theta * theta
    return theta * (1 + square * (k[0] + square * (k[1] + square * (k[2] + square * k[3]))))


def unified(theta: Array, k: Coefficients) -> Array:
    """r = sin / (alpha sqrt(beta sin^2 + cos^2) + (1 - alpha) cos), with k = (alpha, beta).

    Khomutenko, Garcia and Martinet, "An enhanced unified camera model", RA-L 2016, equation 6.
    """
    alpha, beta = k
    sine, cosine = np.sin(theta), np.cos(theta)
    return sine / (alpha * np.sqrt(beta * sine * sine + cosine * cosine) + (1 - alpha) * cosine)


def double_sphere(theta: Array, k: Coefficients) -> Array:
    """r = sin / (alpha sqrt(sin^2 + (xi + cos)^2) + (1 - alpha) (xi + cos)), k = (xi, alpha).

    Usenko, Demmel and Cremers, "The double sphere camera model", 3DV 2018, equations 40 to 42.
    """
    xi, alpha = k
    sine, shifted = np.sin(theta), xi + np.cos(theta)
    return sine / (alpha * np.hypot(sine, shifted) + (1 - alpha) * shifted)


def f_theta(theta: Array, k: Coefficients) -> Array:
    """r = k1 theta + k2 theta^2 + ... + k5 theta^5: the polynomial of NVIDIA's F-theta cameras."""
    return np.asarray(np.polynomial.polynomial.polyval(theta, (0.0, *k)))


MODELS: dict[str, Callable[[Array, Coefficients], Array]] = {
    "kannala_brandt": kannala_brandt,
    "unified": unified,
    "double_sphere": double_sphere,
    "f_theta": f_theta,
}


@dataclass(frozen=True)
class WideLens:
    """A wide lens with a sensor.

    Args:
        model: a key of :data:`MODELS`.
        coefficients: the coefficients of the model.
        fx, fy: focal lengths in px.
        field_of_view: the visible angle, in degrees, through the axis.
        size: width and height of the image in px; None is that of the whole field of view, to
            either side of the principal point.
        centre: the principal point in px from the corner; None for a coordinate is the centre.
    """

    model: str
    coefficients: Coefficients
    fx: float
    fy: float
    field_of_view: float
    size: tuple[int, int] | None = None
    centre: Centre = (None, None)

    @property
    def picture(self) -> tuple[int, int]:
        """Return the width and height of the image.

        Raises:
            ImageError: the model folds within the field of view.
        """
        if self.size:
            return self.size
        edge = float(_table(self)[1][-1])
        return 2 * int(np.ceil(edge * self.fx)), 2 * int(np.ceil(edge * self.fy))

    @property
    def finest(self) -> float:
        """Return the largest number of px in the image per radian from the axis."""
        angles, radii = _table(self)
        return float(np.diff(radii).max() / angles[1] * max(self.fx, self.fy))

    @property
    def principal_point(self) -> tuple[float, float]:
        """Return cx and cy in px from the corner."""
        return centre_in(self.centre, *self.picture)

    def rays(self, x: Array, y: Array) -> Array:
        """Return the directions that positions of the image see.

        Args:
            x: columns in px from the corner, float64 of any shape.
            y: rows in px from the corner, float64 of the same shape.

        Returns:
            (3, ...): right, down and along the axis, of length 1; NaN outside the field of view.
        """
        cx, cy = self.principal_point
        across, down = (x - cx) / self.fx, (y - cy) / self.fy
        r = np.hypot(across, down)
        angles, radii = _table(self)
        theta = np.interp(r, radii, angles, right=np.nan)
        ratio = np.sin(theta) / np.where(r > 0, r, 1)
        return np.stack([across * ratio, down * ratio, np.cos(theta)])

    def project(self, rays: Array) -> tuple[Array, Array]:
        """Return the positions in the image, x and y, of directions, (3, ...).

        NaN outside the field of view. It is the inverse of :meth:`rays`.
        """
        cx, cy = self.principal_point
        side = np.hypot(rays[0], rays[1])
        theta = np.arctan2(side, rays[2])
        theta = np.where(theta <= np.radians(self.field_of_view / 2), theta, np.nan)
        ratio = MODELS[self.model](theta, self.coefficients) / np.where(side > 0, side, 1)
        return cx + self.fx * rays[0] * ratio, cy + self.fy * rays[1] * ratio

    def intrinsics(self) -> Intrinsics:
        """Return the intrinsics by OpenCV's fisheye model; other models are fitted to it."""
        (width, height), (cx, cy) = self.picture, self.principal_point
        k: list[float] = [*self.coefficients]
        longer, off = 1.0, 0.0
        if self.model != "kannala_brandt":
            angles, radii = (each[:: ANGLES // 512] for each in _table(self))
            odd = np.stack([angles**n for n in (1, 3, 5, 7, 9)], 1)
            longer, *k, off = minimax_fit(odd[1:], radii[1:])
            k = [each / longer for each in k]
        fx, fy = self.fx * longer, self.fy * longer
        named = {f"k{i}": each for i, each in enumerate(k, 1)}
        residual = off * max(self.fx, self.fy)
        return Intrinsics(width, height, fx, fy, cx, cy, OPENCV_FISHEYE, named, residual)


@lru_cache(maxsize=32)
def _table(lens: WideLens) -> tuple[Array, Array]:
    """Return angles from the axis to the edge of the field of view, and the r of each.

    Raises:
        ImageError: r does not grow with the angle.
    """
    angles = np.linspace(0, np.radians(lens.field_of_view / 2), ANGLES + 1)
    with np.errstate(all="ignore"):
        radii = MODELS[lens.model](angles, lens.coefficients)
        turns = ~(np.diff(radii) > 0)
    if turns.any():
        seen = np.degrees(angles[int(turns.argmax())])
        raise ImageError(
            f"projection: {lens.model} with these coefficients sees at most {2 * seen:.1f} "
            f"degrees, but field_of_view is {lens.field_of_view:g}; make it smaller, or use "
            "coefficients with which r grows up to there"
        )
    return angles, radii
