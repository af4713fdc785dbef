"""Lens distortion: radial models, their inverses, and the position that each pixel shows.

Positions are counted like in :mod:`clpipe.reference.geometry`. In a model, r is the distance from
the principal point in units of the focal length, or of half the short side.
"""

from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np

from clpipe.base.cache import cached_hash
from clpipe.base.errors import ImageError, RequestError
from clpipe.base.types import Array
from clpipe.reference.geometry import NO_MARGINS, Centre, Margins, centre_in
from clpipe.reference.intrinsics import (
    DECENTRING,
    FULL_OPENCV,
    OPENCV_FISHEYE,
    PINHOLE,
    THIN_PRISM,
    Intrinsics,
)
from clpipe.reference.radial import (
    RESIDUAL,
    STRAIGHT,
    Radial,
    even_powers,
    fold_radius,
    inverse_ratio,
    inversion_radius,
)


@cached_hash
@dataclass(frozen=True)
class DistortionMap:
    """A lens as a map of an image: the origin of the light of each pixel.

    Args:
        radial: the model of green, and without lateral colour of all channels.
        tangential: p1 and p2 of Brown and Conrady's model.
        prism: s1 to s4 of OpenCV's thin prism.
        focal: fx and fy in px, the model's unit.
        relative_focal_length: without ``focal``, the focal length over the longer side. Without
            either, the unit is that of lateral colour.
        centre: the principal point in px from the corner; None, for one coordinate or both, is the
            centre.
        red, blue: lateral colour: r of red, or blue, from r of green, in the image; r = 1 is half
            the short side.
        half_diagonals: r = 1 of lateral colour in half diagonals of the image, if set.
        fit: whether the image is scaled about the principal point to show as much as possible
            without void pixels.
        margins: how far the input extends outside the frame that the lens-free image would have.
            The input's width and height include them. ``centre`` and all units do not.
    """

    radial: Radial = STRAIGHT
    tangential: tuple[float, float] = (0.0, 0.0)
    prism: tuple[float, float, float, float] = (0.0, 0.0, 0.0, 0.0)
    focal: tuple[float, float] | None = None
    relative_focal_length: float | None = None
    centre: Centre = (None, None)
    red: Radial = STRAIGHT
    blue: Radial = STRAIGHT
    half_diagonals: float | None = None
    fit: bool = False
    margins: Margins = NO_MARGINS

    @property
    def is_identity(self) -> bool:
        """Whether it leaves every image unchanged."""
        models = self.radial, self.red, self.blue
        is_straight = all(each.is_identity for each in models)
        return is_straight and not any((*self.tangential, *self.prism))

    def unit(self, width: int, height: int) -> tuple[float, float]:
        """Return r = 1 for an image of this size, in px across and down."""
        side = (
            self.relative_focal_length * max(width, height)
            if self.relative_focal_length
            else self.side(width, height)
        )
        return self.focal or (side, side)

    def side(self, width: int, height: int) -> float:
        """Return r = 1 of lateral colour for an image of this size, in px."""
        across, down = max(width - 1, 1), max(height - 1, 1)  # lensfun's definition
        if self.half_diagonals:
            return float(self.half_diagonals * np.hypot(across, down) / 2)
        return min(across, down) / 2

    def size(self, width: int, height: int) -> tuple[int, int]:
        """See :meth:`clpipe.reference.geometry.Geometry.size`."""
        return self.margins.frame_size(width, height)

    def origins(self, x: Array, y: Array, width: int, height: int) -> tuple[Array, Array]:
        """See :meth:`clpipe.reference.geometry.Geometry.origins`."""
        return self.source_positions(x, y, width, height)

    def source_positions(
        self, x: Array, y: Array, width: int, height: int, lateral: Radial | None = None
    ) -> tuple[Array, Array]:
        """Return the positions in the render that positions of the image show, in px, float64.

        Args:
            x: columns of positions in the image; float64, of any shape.
            y: their rows; float64, of the same shape.
            width: the width of the input in px.
            height: its height in px.
            lateral: the lateral colour of the channel.

        Raises:
            ImageError: the lens folds the image over, or no scale avoids void pixels.
        """
        scale = self.scale(width, height)
        scaled_lens = _ScaledLens(self, *self.size(width, height), scale)
        u, v = scaled_lens.source_positions(x, y, lateral or STRAIGHT)
        return u + self.margins.left, v + self.margins.top

    def intrinsics(self, known: Intrinsics | None, width: int, height: int) -> Intrinsics | None:
        """See :meth:`clpipe.reference.geometry.Geometry.intrinsics`.

        Those of the render are for its part without margins. If they are not known, they follow
        from the model's unit, if that is focal lengths. COLMAP's models cover those of Brown and
        Conrady, the fisheye's, poly3 and poly5. The model ptlens, whose powers are odd, is fitted
        by them.
        """
        scale = self.scale(width, height)
        width, height = self.size(width, height)
        unit = self.unit(width, height)
        centre = centre_in(self.centre, width, height)
        has_focal = bool(self.focal or self.relative_focal_length)
        if known is None:
            if not has_focal:
                return None
            known = Intrinsics(width, height, *unit, *centre)
        stated = {"cx": centre[0], "cy": centre[1]} | (
            {"fx": unit[0], "fy": unit[1]} if has_focal else {}
        )
        for name, value in stated.items():
            if not np.isclose(value, rendered := getattr(known, name), rtol=1e-6):
                raise RequestError(
                    f"distortion: its {name} is {value:g} px, but that of the render is "
                    f"{rendered:g} px; set render.{name} and distortion to the same value, or only "
                    "one of them"
                )
        is_square = has_focal or np.isclose(known.fx, known.fy, rtol=1e-4)
        scaled_lens = _ScaledLens(self, width, height, scale)
        model = even_powers(self.radial, scaled_lens.corner / scale, scaled_lens.farthest)
        if known.model != PINHOLE or not is_square or model is None:
            return None
        above, below, error = model
        if len(above) > (5 if self.radial.of_angle else 4) or len(below) > 4:
            return None
        ratio = 1.0 if has_focal else known.fx / unit[0]  # r over the radius in focal lengths
        first, *others = above
        k = [c / first * ratio ** (2 * i) for i, c in enumerate(others, 1)]
        residual = error * max(unit) * scale
        scale *= first
        parameters = known.fx * scale, known.fy * scale, known.cx, known.cy
        named = {f"k{i}": value for i, value in enumerate(k, 1)}
        if self.radial.of_angle:
            return Intrinsics(width, height, *parameters, OPENCV_FISHEYE, named)
        denominator = {f"k{i + 3}": c * ratio ** (2 * i) for i, c in enumerate(below) if i}
        shifts = *self.tangential, *self.prism
        named |= denominator | dict(zip(DECENTRING, shifts, strict=True))
        name = THIN_PRISM if any(self.prism) else FULL_OPENCV
        return Intrinsics(width, height, *parameters, name, named, residual)

    def scale(self, width: int, height: int) -> float:
        """Return the factor by which ``fit`` lengthens an image's focal length; 1 without it.

        With margins, the image shows only as much of them as it needs. The focal length does not
        become shorter than it is, or than it would become without margins.

        Raises:
            ImageError: like in :meth:`seen`.
        """
        if not self.fit:
            return 1.0
        scale = fitting_scale(self, *self.size(width, height))
        if self.margins and scale < 1:
            scale = max(scale, min(1.0, self._without_margins.scale(*self.size(width, height))))
        return scale

    @property
    def _without_margins(self) -> "DistortionMap":
        return replace(self, margins=NO_MARGINS)


class _ScaledLens:
    """A lens and an image of some size, scaled by ``scale``; margins are outside the image."""

    def __init__(self, lens: DistortionMap, width: int, height: int, scale: float) -> None:
        self.lens, self.scale, self.side = lens, scale, lens.side(width, height)
        self.unit = lens.unit(width, height)
        self.centre = centre_in(lens.centre, width, height)
        self.size = width, height
        left, top, right, bottom = lens.margins
        offsets = self._corners(0, 0, width, height)
        self.corner = float(np.hypot(*(offsets / self.unit).T).max())
        self.corner_side = float(np.hypot(*(offsets / self.side).T).max()) / scale
        offsets = self._corners(-left, -top, width + right, height + bottom)
        # Radius of the input's corner.
        self.farthest = float(np.hypot(*(offsets / self.unit).T).max())
        self._check(lens.radial, self.farthest, self.corner, "distortion", max(self.unit))
        for lateral in (lens.red, lens.blue):
            self._check(lateral, self.corner_side, self.corner_side, "lateral colour", self.side)

    def _corners(self, left: int, top: int, right: int, bottom: int) -> Array:
        """Return the vectors from the principal point to a rectangle's corners, (corner, 2) px."""
        return np.array([(x, y) for x in (left, right) for y in (top, bottom)], float) - self.centre

    def _check(
        self, radial: Radial, farthest: float, corner: float, what: str, unit: float
    ) -> None:
        """Check that a model does not fold within the part of the input that the image shows.

        Args:
            radial: the model.
            farthest: r of the farthest corner of the input.
            corner: r_d of the farthest corner of the image.
            what: the name of the length, for the message.
            unit: its unit, for the message.
        """
        at = None if radial.is_identity else fold_radius(radial, farthest)
        if at is not None and not radial.distort(np.array(at)) > corner:
            raise self.folded(what, at, at * unit)

    def folded(self, what: str, r: float, px: float) -> ImageError:
        """Return the error for coefficients that fold the image over at some radius."""
        width, height = self.lens.margins.image_size(*self.size)
        less = ", or less overscan" if self.lens.margins else ""
        return ImageError(
            f"distortion: these coefficients fold the image over. The {what} folds at r = "
            f"{r:.4g}, {px:.0f} px from the principal point, but the corner of {width}x{height} "
            f"pixels is at r = {self.farthest:.4g}. Use coefficients that grow up to there, or "
            f"a longer focal length{less}"
        )

    def source_positions(self, x: Array, y: Array, lateral: Radial) -> tuple[Array, Array]:
        """See :meth:`DistortionMap.source_positions`."""
        lens = self.lens
        dx, dy = (x - self.centre[0]) / self.scale, (y - self.centre[1]) / self.scale
        # The radius of green at which the channel's radius is the pixel's.
        ratio = inverse_ratio(lateral, np.hypot(dx, dy) / self.side, self.corner_side)
        dx, dy = dx * ratio / self.unit[0], dy * ratio / self.unit[1]
        ratio = inverse_ratio(lens.radial, np.hypot(dx, dy), self.farthest)
        ux, uy = dx * ratio, dy * ratio
        if any((*lens.tangential, *lens.prism)):
            ux, uy = self._with_decentring(ux, uy, dx, dy)
        return self.centre[0] + ux * self.unit[0], self.centre[1] + uy * self.unit[1]

    def _with_decentring(self, ux: Array, uy: Array, dx: Array, dy: Array) -> tuple[Array, Array]:
        """Newton's method in two dimensions, from the inverse of the radial part."""
        lens, (p1, p2), (s1, s2, s3, s4) = self.lens, self.lens.tangential, self.lens.prism
        farthest = inversion_radius(lens.radial, self.farthest)
        initial = ux, uy
        slope = np.zeros(())
        for _ in range(50):
            r = np.maximum(np.hypot(ux, uy), 1e-12)
            within = np.minimum(r, farthest)
            distorted, slope = lens.radial.distort(within), lens.radial.slope(within)
            outer_slope = max(float(lens.radial.slope(np.array(farthest))), 0.25)
            distorted, slope = (
                distorted + (r - within) * outer_slope,
                np.where(r > farthest, outer_slope, slope),
            )
            ratio = distorted / r
            curvature = (slope - ratio) / (r * r)  # slope of the ratio over r, divided by r
            square = r * r
            fx = ux * ratio + 2 * p1 * ux * uy + p2 * (square + 2 * ux * ux) - dx
            fy = uy * ratio + p1 * (square + 2 * uy * uy) + 2 * p2 * ux * uy - dy
            fx, fy = fx + square * (s1 + s2 * square), fy + square * (s3 + s4 * square)
            across, down = 2 * s1 + 4 * s2 * square, 2 * s3 + 4 * s4 * square
            xx = ratio + ux * ux * curvature + 2 * p1 * uy + (6 * p2 + across) * ux
            both = ux * uy * curvature + 2 * p1 * ux + 2 * p2 * uy
            xy, yx = both + across * uy, both + down * ux
            yy = ratio + uy * uy * curvature + (6 * p1 + down) * uy + 2 * p2 * ux
            determinant = xx * yy - xy * yx
            safe = np.where(np.abs(determinant) > 1e-6, determinant, 1e-6)
            ux, uy = ux - (yy * fx - xy * fy) / safe, uy - (xx * fy - yx * fx) / safe
            if max(np.abs(fx).max(initial=0), np.abs(fy).max(initial=0)) < RESIDUAL:
                break
        wrong = ~((determinant > 0) & (np.hypot(fx, fy) < 1e-9))
        if wrong.any():
            r = np.hypot(*initial)
            within = wrong & (r <= self.farthest)
            if within.any():
                first = float(r[within].min())
                raise self.folded("distortion", first, first * max(self.unit))
            ux, uy = np.where(wrong, initial[0], ux), np.where(wrong, initial[1], uy)
        return ux, uy


@lru_cache(maxsize=256)
def fitting_scale(lens: DistortionMap, width: int, height: int) -> float:
    """Return the scale at which the image shows as much as possible without void pixels.

    Args:
        lens: the lens, with the margins of the render.
        width: the width of the image in px.
        height: its height in px.

    Raises:
        ImageError: there is none between 1/8 and 8, or the lens folds the image over.
    """
    across, down = np.linspace(0, width, 129), np.linspace(0, height, 129)
    left, top, right, bottom = lens.margins
    x = np.concatenate([across, across, np.zeros(129), np.full(129, width)])
    y = np.concatenate([np.zeros(129), np.full(129, height), down, down])

    def is_full(scale: float) -> bool:
        try:
            scaled_lens = _ScaledLens(lens, width, height, scale)
            channels = dict.fromkeys((lens.red, STRAIGHT, lens.blue))
            positions = [scaled_lens.source_positions(x, y, each) for each in channels]
        except ImageError:  # the lens folds this far outside
            return False
        return all(
            u.min() >= -left
            and v.min() >= -top
            and u.max() <= width + right
            and v.max() <= height + bottom
            for u, v in positions
        )

    _ScaledLens(lens, width, height, 1.0)  # rejects a lens that folds the image
    low, high = 1 / 8, 8.0
    if not is_full(high):
        raise ImageError(
            f"distortion: no scale fits the image of {width}x{height} pixels into the render; "
            "check that cx and cy are in the image, or set fit=false"
        )
    for _ in range(26):  # 26 bisections, for a precision of 1e-7
        middle = (low * high) ** 0.5
        low, high = (low, middle) if is_full(middle) else (middle, high)
    return high
