"""The surroundings of one point: perspective views, or a map of longitude and latitude.

Its pixels are in one image, the atlas. Views are stacked vertically, each with a border that shows
its surroundings. Directions are (3, ...): right, down and along the axis of the output camera.
"""

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from functools import cached_property
from typing import Any, Protocol

import numpy as np

from clpipe.base.types import Array
from clpipe.reference.carried import bilinear, nearest
from clpipe.reference.warp import FILTERS

BORDER = 4  # px; filters extend 3 px around a position
# Passes that fill borders; in the second pass, borders are also filled from each other.
BORDER_PASSES = 2
EDGE = 1e-6  # relative to a view's side; a view also covers directions this far outside it

Rotation = tuple[tuple[float, float, float], ...]

# The axes of a view's camera (right, down, ahead) in the columns of its rotation.
FRONT: Rotation = ((1, 0, 0), (0, 1, 0), (0, 0, 1))
RIGHT: Rotation = ((0, 0, 1), (0, 1, 0), (-1, 0, 0))
BACK: Rotation = ((-1, 0, 0), (0, 1, 0), (0, 0, -1))
LEFT: Rotation = ((0, 0, -1), (0, 1, 0), (1, 0, 0))
UP: Rotation = ((1, 0, 0), (0, 0, -1), (0, 1, 0))
DOWN: Rotation = ((1, 0, 0), (0, 0, 1), (0, -1, 0))

CUBE = {"front": FRONT, "right": RIGHT, "back": BACK, "left": LEFT, "up": UP, "down": DOWN}

# OpenEXR's order, +x, -x, +y, -y, +z and -z, where y is up, z ahead, and x to the left. The faces
# above and below are rotated by 180 degrees (ImfEnvmap.cpp of OpenEXR 3).
OPENEXR_CUBE = (
    LEFT,
    RIGHT,
    ((-1, 0, 0), (0, 0, -1), (0, -1, 0)),
    ((-1, 0, 0), (0, 0, 1), (0, 1, 0)),
    FRONT,
    BACK,
)


class Panorama(Protocol):
    """The mapping between directions and an atlas.

    A subclass has a ``border``, px around each view in the atlas.
    """

    border: int

    @property
    def count(self) -> int:
        """The number of images in the atlas."""
        return 1

    @property
    def size(self) -> tuple[int, int]:
        """The atlas's width and height in px."""
        ...

    @property
    def record(self) -> dict[str, Any]:
        """Its description, as JSON values."""
        ...

    def positions(self, rays: Array) -> tuple[Array, Array]:
        """Return the positions of directions in the atlas, x and y in px; NaN outside all views."""
        ...

    def rays(self, x: Array, y: Array, at: tuple[Array, Array] | None = None) -> Array:
        """Return the directions of positions of the atlas, of any length above 0.

        Args:
            x: the columns of the positions, px.
            y: their rows, px.
            at: positions in the views that select the view; None is the positions themselves. A
                vector may therefore end outside a view.
        """
        ...

    def atlas(self, images: Sequence[Array], filter_: str) -> Array:
        """Return the atlas of the images of all views, (height, width, channel), of their type.

        Args:
            images: by view, without borders.
            filter_: how borders are filled from other views: a key of :data:`FILTERS`, "linear" or
                "nearest". "" repeats the view's own edge, for data in units of its pixels.
        """
        if not self.border:
            return np.concatenate(images)
        sides = ((self.border, self.border), (self.border, self.border), (0, 0))
        whole = np.concatenate([np.pad(image, sides, "edge") for image in images])
        row, column, x, y = self._borders
        for _ in range(BORDER_PASSES if filter_ else 0):
            whole[row, column] = sample(whole, x, y, filter_)
        return whole

    @cached_property
    def _borders(self) -> tuple[Array, Array, Array, Array]:
        """Return rows and columns of border pixels that other views show, and positions there."""
        width, height = self.size
        is_border = np.ones((height // self.count, width), bool)
        is_border[self.border : -self.border, self.border : -self.border] = False
        row, column = np.nonzero(np.tile(is_border, (self.count, 1)))
        x, y = self.positions(self.rays(column + 0.5, row + 0.5))
        known = np.isfinite(x)
        return row[known], column[known], x[known], y[known]


@dataclass(frozen=True)
class View:
    """A perspective view: its camera's axes, focal lengths, principal point and size in px."""

    rotation: Rotation
    fx: float
    fy: float
    cx: float
    cy: float
    width: int
    height: int

    @classmethod
    def from_angle(cls, rotation: Rotation, width: int, height: int, angle: float) -> "View":
        """Return a view with a horizontal field of view in degrees."""
        f = width / 2 / np.tan(np.radians(angle / 2))
        return cls(rotation, f, f, width / 2, height / 2, width, height)

    def lengths(self) -> Array:
        """Return the distance at depth 1 along the axis, (height, width)."""
        x = (np.arange(self.width) + 0.5 - self.cx) / self.fx
        y = (np.arange(self.height) + 0.5 - self.cy) / self.fy
        return np.sqrt(1 + x * x + (y * y)[:, None])


@dataclass(frozen=True)
class Views(Panorama):
    """Perspective views from one point; each direction uses the view whose edges are farthest.

    Args:
        views: the views, all of one size.
        border: px around each view in the atlas.
    """

    views: tuple[View, ...]
    border: int = BORDER

    @property
    def count(self) -> int:
        """See :attr:`Panorama.count`."""
        return len(self.views)

    @property
    def size(self) -> tuple[int, int]:
        """See :attr:`Panorama.size`."""
        first, margin = self.views[0], 2 * self.border
        return first.width + margin, (first.height + margin) * len(self.views)

    @property
    def record(self) -> dict[str, Any]:
        """See :attr:`Panorama.record`; the rotations lead from a view's axes to the image's."""
        return {"views": [asdict(view) for view in self.views]}

    def positions(self, rays: Array) -> tuple[Array, Array]:
        """See :meth:`Panorama.positions`."""
        best = np.full(rays.shape[1:], -np.inf)
        found_x, found_y = np.full(best.shape, np.nan), np.full(best.shape, np.nan)
        for number, view in enumerate(self.views):
            right, down, ahead = np.tensordot(np.array(view.rotation).T, rays, 1)
            with np.errstate(all="ignore"):
                x = view.cx + view.fx * right / ahead
                y = view.cy + view.fy * down / ahead
                within_x = np.minimum(x, view.width - x) / view.width
                within_y = np.minimum(y, view.height - y) / view.height
            within = np.where(ahead > 0, np.minimum(within_x, within_y), -np.inf)
            is_best = (within > best) & (within >= -EDGE)
            best = np.where(is_best, within, best)
            found_x = np.where(is_best, np.clip(x, 0, view.width) + self.border, found_x)
            top = number * (view.height + 2 * self.border) + self.border
            found_y = np.where(is_best, np.clip(y, 0, view.height) + top, found_y)
        return found_x, found_y

    def rays(self, x: Array, y: Array, at: tuple[Array, Array] | None = None) -> Array:
        """See :meth:`Panorama.rays`."""
        first = self.views[0]
        pitch = first.height + 2 * self.border
        row = y if at is None else at[1]
        number = np.clip(np.nan_to_num(row) // pitch, 0, len(self.views) - 1)
        result = np.full((3, *np.shape(x)), np.nan)
        for each, view in enumerate(self.views):
            right = (x - self.border - view.cx) / view.fx
            down = (y - each * pitch - self.border - view.cy) / view.fy
            view_rays = np.stack([right, down, np.ones_like(right)])
            rotated = np.tensordot(np.array(view.rotation, float), view_rays, 1)
            result = np.where(number == each, rotated, result)
        return result


@dataclass(frozen=True)
class LatitudeLongitude(Panorama):
    """All directions by longitude, to the right, and latitude; the centre is ahead.

    Args:
        width, height: of the map in px.
        on_edges: whether the first and last columns and rows are at the ends of longitude and
            latitude, like in OpenEXR, and not half a pixel inside.
        border: px around the map in the atlas.
    """

    width: int
    height: int
    on_edges: bool = False
    border: int = BORDER

    @property
    def size(self) -> tuple[int, int]:
        """See :attr:`Panorama.size`."""
        return self.width + 2 * self.border, self.height + 2 * self.border

    @property
    def record(self) -> dict[str, Any]:
        """See :attr:`Panorama.record`."""
        return {"map": {"width": self.width, "height": self.height, "on_edges": self.on_edges}}

    @property
    def _steps(self) -> tuple[float, float]:
        """The radians between columns and between rows."""
        less = 1 if self.on_edges else 0
        return 2 * np.pi / max(self.width - less, 1), np.pi / max(self.height - less, 1)

    def positions(self, rays: Array) -> tuple[Array, Array]:
        """See :meth:`Panorama.positions`."""
        across, down = self._steps
        longitude = np.arctan2(rays[0], rays[2])
        latitude = np.arctan2(rays[1], np.hypot(rays[0], rays[2]))
        return (
            self.width / 2 + longitude / across + self.border,
            self.height / 2 + latitude / down + self.border,
        )

    def rays(self, x: Array, y: Array, at: tuple[Array, Array] | None = None) -> Array:
        """See :meth:`Panorama.rays`."""
        across, down = self._steps
        longitude = (x - self.border - self.width / 2) * across
        latitude = (y - self.border - self.height / 2) * down
        flat = np.cos(latitude)
        return np.stack([np.sin(longitude) * flat, np.sin(latitude), np.cos(longitude) * flat])


def sample(pixels: Array, x: Array, y: Array, filter_: str) -> Array:
    """Return pixels, (rows, columns, channel), at positions between their centres.

    Args:
        pixels: the image, continued by its edge pixels.
        x: the columns of the positions, 1-D.
        y: their rows, 1-D.
        filter_: a key of :data:`FILTERS`, or "linear" or "nearest".
    """
    if filter_ == "nearest":
        return nearest(pixels, x, y)
    if filter_ == "linear":
        return bilinear(pixels, x, y).astype(pixels.dtype)
    polynomials = FILTERS[filter_].astype(np.float64)
    first = 1 - len(polynomials) // 2
    left, top = np.floor(x - 0.5), np.floor(y - 0.5)
    of_column, of_row = (
        [np.polynomial.polynomial.polyval(fraction, each) for each in polynomials]
        for fraction in (x - 0.5 - left, y - 0.5 - top)
    )
    total = np.zeros((len(x), pixels.shape[2]))
    for j, down in enumerate(of_row):
        for i, across in enumerate(of_column):
            samples = nearest(pixels, left + (first + i), top + (first + j))
            total += (across * down)[:, None] * samples
    return total.astype(pixels.dtype)
