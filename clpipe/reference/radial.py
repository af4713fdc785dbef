"""Radial lens models: the distance of a point from the axis, and the inverse.

In a model, r is the distance from the principal point in the model's unit.
"""

from dataclasses import dataclass
from functools import lru_cache
from typing import Self

import numpy as np
from numpy.polynomial.polynomial import polyder, polyval

from clpipe.base.types import Array
from clpipe.reference.rational import fit_even

# In units of r; Newton's method ends when the error after distortion is below this value. For a
# focal length of 4000 px, this is 4e-9 px.
RESIDUAL = 1e-12
SAMPLES = 2049  # starting points for the inverse of a radial model
# For interpolation, the model continues outside the corner up to this multiple of its radius.
# Farther out, it continues as a straight line.
EXTENSION = 1.25


@dataclass(frozen=True)
class Radial:
    """r_d = N(r) / M(r), polynomials with their coefficients from the lowest power up.

    With ``of_angle``, they are polynomials of atan(r), the angle to the axis.

    >>> cubic = Radial((0.0, 1.0, 0.0, -0.1))
    >>> float(cubic.distort(np.array(0.5))), float(cubic.slope(np.array(0.5)))
    (0.4875, 0.925)
    """

    numerator: tuple[float, ...] = (0.0, 1.0)
    denominator: tuple[float, ...] = (1.0,)
    of_angle: bool = False

    @classmethod
    def of(
        cls, *numerator: float, denominator: tuple[float, ...] = (), of_angle: bool = False
    ) -> Self:
        """Return the model N(r) / (1 + M(r)), each polynomial from r^1 up, without trailing zeros.

        >>> Radial.of(1.0, 0.0, 0.0).is_identity
        True
        """
        above, under = (
            tuple(map(float, np.trim_zeros(c, "b")))
            for c in ((0.0, *numerator), (1.0, *denominator))
        )
        return cls(above, under, of_angle)

    @property
    def is_identity(self) -> bool:
        """Whether every r_d is r."""
        return self == STRAIGHT

    def distort(self, r: Array) -> Array:
        """Return r_d, the radius in the image, of r, the radius without the lens; float64."""
        x = np.arctan(r) if self.of_angle else r
        return polyval(x, self.numerator) / polyval(x, self.denominator)

    def slope(self, r: Array) -> Array:
        """Return the derivative of :meth:`distort`."""
        x = np.arctan(r) if self.of_angle else r
        n, m = polyval(x, self.numerator), polyval(x, self.denominator)
        dn, dm = polyval(x, polyder(self.numerator)), polyval(x, polyder(self.denominator))
        slope = (dn * m - n * dm) / (m * m)
        return slope / (1 + r * r) if self.of_angle else slope

    def undistort(self, r_d: Array, farthest: float) -> Array:
        """Return r of each r_d, by Newton's method to :data:`RESIDUAL`.

        Args:
            r_d: radii in the image.
            farthest: the radius up to which the model grows and is inverted. Outside its r_d, r
                continues as a straight line.
        """
        if self.is_identity:
            return r_d
        known = np.linspace(0, farthest, SAMPLES)
        distort = self.distort(known)
        inside = np.minimum(r_d, distort[-1])
        r = np.interp(inside, distort, known)
        for _ in range(20):
            error = self.distort(r) - inside
            if np.abs(error).max(initial=0) < RESIDUAL:
                break
            r = np.clip(r - error / np.maximum(self.slope(r), 1e-9), 0, farthest)
        # A slope near 0 would move points outside the image far away.
        slope = max(float(self.slope(known[-1])), 0.25 * distort[-1] / farthest)
        return r + (r_d - inside) / slope


STRAIGHT = Radial()  # r_d equals r


@lru_cache(maxsize=64)
def fold_radius(radial: Radial, farthest: float) -> float | None:
    """Return the first radius up to ``farthest`` at which r_d stops growing; None if there is none.

    >>> round(fold_radius(Radial((0.0, 1.0, 0.0, -0.5)), 1.0), 3)
    0.816
    """
    r = np.linspace(0, farthest, SAMPLES)
    x = np.arctan(r) if radial.of_angle else r
    with np.errstate(divide="ignore", invalid="ignore"):
        grows = (radial.slope(r) > 0) & (polyval(x, radial.denominator) > 0)
    if grows.all():
        return None
    first = int(grows.argmin())
    low, high = float(r[max(first - 1, 0)]), float(r[first])
    for _ in range(40):
        middle = (low + high) / 2
        low, high = (middle, high) if radial.slope(np.array(middle)) > 0 else (low, middle)
    return high


def inversion_radius(radial: Radial, corner: float) -> float:
    """Return the radius up to which a model is inverted: slightly outside the corner."""
    at = fold_radius(radial, EXTENSION * corner)
    return EXTENSION * corner if at is None else max(0.999 * at, min(corner, at))


def inverse_ratio(radial: Radial, r_d: Array, corner: float) -> Array:
    """Return r over r_d, the inverse of a model as a factor."""
    if radial.is_identity:
        return np.ones_like(r_d)
    at_centre = 1 / radial.slope(np.zeros(()))
    r = radial.undistort(r_d, inversion_radius(radial, corner))
    return np.divide(r, r_d, out=np.full_like(r_d, at_centre), where=r_d > 0)


@lru_cache(maxsize=64)
def even_powers(
    radial: Radial, corner: float, farthest: float
) -> tuple[list[float], list[float], float] | None:
    """Return N and M of r_d = r N(r^2) / M(r^2), from the lowest power up, and their error.

    They are those of the model or, if it has odd powers, those of :func:`fit_even`. The result is
    None if there are none.

    Args:
        radial: the model; for a model of the angle, r^2 is its square.
        corner: r_d at the corner of the image.
        farthest: largest r that is visible.
    """
    above, below = radial.numerator[1:], radial.denominator
    if not any(above[1::2]) and not any(below[1::2]):
        return list(above[::2]), list(below[::2]), 0.0
    if radial.of_angle:
        return None
    bound = inversion_radius(radial, farthest)
    longest = min(float(radial.undistort(np.array([corner]), bound)[0]), bound)
    r = longest * (1 - np.cos(np.linspace(0, np.pi, 201))) / 2  # close together at both ends
    return fit_even(r, radial.distort(r))
