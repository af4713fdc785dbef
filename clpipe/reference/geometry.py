"""The origin of pixels: how stages move image content, for all layers and annotations.

Positions are in pixels from the image's upper left corner. The centre of the first pixel is at
(0.5, 0.5), like in COLMAP. In OpenCV it is at (0, 0).
"""

from dataclasses import dataclass, replace
from typing import NamedTuple, Protocol

import numpy as np

from clpipe.base.types import Array
from clpipe.reference.intrinsics import Intrinsics
from clpipe.reference.resample import Bins, Resampling, sizes


class Margins(NamedTuple):
    """How far an image extends outside the frame, in px: overscan.

    >>> Margins(3, 2, 1, 0).frame_size(10, 8), bool(NO_MARGINS)
    ((6, 6), False)
    """

    left: int = 0
    top: int = 0
    right: int = 0
    bottom: int = 0

    def __bool__(self) -> bool:
        return any(self)

    def frame_size(self, width: int, height: int) -> tuple[int, int]:
        """Return the width and height of the frame, from the image's."""
        return width - self.left - self.right, height - self.top - self.bottom

    def image_size(self, width: int, height: int) -> tuple[int, int]:
        """Return the width and height of the image, from the frame's."""
        return width + self.left + self.right, height + self.top + self.bottom

    def cropped(self, image: Array) -> Array:
        """Return the frame of an image, (height, width[, channel]): a view."""
        height, width = image.shape[:2]
        return image[self.top : height - self.bottom, self.left : width - self.right]


NO_MARGINS = Margins()

# x and y in px from the upper left corner; None, for one or both, is the centre.
Centre = tuple[float | None, float | None]


def centre_in(centre: Centre, width: float, height: float) -> tuple[float, float]:
    """Return a point in an image of some size, in px from its upper left corner.

    >>> centre_in((None, 2.0), 6, 8)
    (3.0, 2.0)
    """
    x, y = centre
    return width / 2 if x is None else x, height / 2 if y is None else y


class Geometry(Protocol):
    """How a stage moves the pixels of an image of some width and height, in px."""

    def size(self, width: int, height: int) -> tuple[int, int]:
        """Return the width and height of the output, from the input's."""
        ...

    def origins(self, x: Array, y: Array, width: int, height: int) -> tuple[Array, Array]:
        """Return the positions in the input for positions of the output; float64 of any shape.

        For a lens with lateral colour, these are the positions of green. Positions may be outside
        the image, where nothing is known.

        Args:
            x: columns of positions in the output.
            y: their rows.
            width: the width of the input in px.
            height: its height in px.
        """
        ...

    def intrinsics(self, known: Intrinsics | None, width: int, height: int) -> Intrinsics | None:
        """Return the intrinsics of the output, from the input's; None if not known.

        Raises:
            RequestError: they contradict this stage.
        """
        ...


class ForwardMapped:
    """A geometry that maps positions of the image forward to its result."""

    def destinations(
        self, x: Array, y: Array, at: tuple[Array, Array], width: int, height: int
    ) -> tuple[Array, Array]:
        """Return the positions in the output for positions of the input; NaN if there is none.

        Args:
            x: the columns of the positions.
            y: their rows.
            at: positions in the image that select the view, for the start of a vector.
            width: the width of the input in px.
            height: its height in px.
        """
        raise NotImplementedError(type(self).__name__)


@dataclass(frozen=True)
class Scaling(ForwardMapped):
    """Fewer rows and columns, each by at most one resampling; the first edges stay.

    >>> import numpy as np
    >>> from clpipe.reference.resample import Resampling, overlap
    >>> half = Scaling((Resampling("columns", 0.5, overlap, 0.5),))
    >>> half.size(8, 6), half.origins(np.array(0.5), np.array(0.5), 8, 6)
    ((4, 6), (np.float64(1.0), np.float64(0.5)))
    """

    resamplings: tuple[Resampling | Bins, ...]

    def size(self, width: int, height: int) -> tuple[int, int]:
        """See :meth:`Geometry.size`."""
        return sizes(self.resamplings, width, height)[-1]

    def shown(self, width: int, height: int) -> tuple[int, int]:
        """Return the columns and rows of the image that the result covers, from the upper left.

        >>> from clpipe.reference.resample import Bins
        >>> Scaling((Bins("rows", 2), Bins("columns", 2))).shown(611, 407)
        (610, 406)
        """
        found = {"columns": width, "rows": height}
        for each in self.resamplings:
            found[each.axis] = each.shown(found[each.axis])
        return found["columns"], found["rows"]

    def origins(self, x: Array, y: Array, width: int, height: int) -> tuple[Array, Array]:
        """See :meth:`Geometry.origins`."""
        columns, rows = self.size(width, height)
        across, down = self.shown(width, height)
        return x * (across / columns), y * (down / rows)

    def destinations(
        self, x: Array, y: Array, at: tuple[Array, Array], width: int, height: int
    ) -> tuple[Array, Array]:
        """See :meth:`ForwardMapped.destinations`; exact at the edges."""
        columns, rows = self.size(width, height)
        across, down = self.shown(width, height)
        return x * columns / across, y * rows / down

    def intrinsics(self, known: Intrinsics | None, width: int, height: int) -> Intrinsics | None:
        """See :meth:`Geometry.intrinsics`."""
        return known and known.scaled(*self.size(width, height), self.shown(width, height))


@dataclass(frozen=True)
class Composition:
    """Several geometries in sequence; each gets the result of the previous one.

    >>> import numpy as np
    >>> from clpipe.reference.resample import Resampling, overlap
    >>> half = Scaling((Resampling("columns", 0.5, overlap, 0.5),))
    >>> twice = Composition((half, half))
    >>> twice.size(8, 6), twice.origins(np.array(0.5), np.array(0.5), 8, 6)
    ((2, 6), (np.float64(2.0), np.float64(0.5)))
    """

    parts: tuple[Geometry, ...]

    def size(self, width: int, height: int) -> tuple[int, int]:
        """See :meth:`Geometry.size`."""
        for part in self.parts:
            width, height = part.size(width, height)
        return width, height

    def origins(self, x: Array, y: Array, width: int, height: int) -> tuple[Array, Array]:
        """See :meth:`Geometry.origins`."""
        sizes_ = [(width, height)]
        for part in self.parts:
            sizes_.append(part.size(*sizes_[-1]))
        for part, size in zip(reversed(self.parts), reversed(sizes_[:-1]), strict=True):
            x, y = part.origins(x, y, *size)
        return x, y

    def intrinsics(self, known: Intrinsics | None, width: int, height: int) -> Intrinsics | None:
        """See :meth:`Geometry.intrinsics`."""
        for part in self.parts:
            known = part.intrinsics(known, width, height)
            width, height = part.size(width, height)
        return known


@dataclass(frozen=True)
class Orientation:
    """An image rotated upright: flipped left to right, upside down, then transposed."""

    mirrored: bool
    upside_down: bool
    transposed: bool

    def size(self, width: int, height: int) -> tuple[int, int]:
        """See :meth:`Geometry.size`."""
        return (height, width) if self.transposed else (width, height)

    def origins(self, x: Array, y: Array, width: int, height: int) -> tuple[Array, Array]:
        """See :meth:`Geometry.origins`."""
        x, y = (y, x) if self.transposed else (x, y)
        return width - x if self.mirrored else x, height - y if self.upside_down else y

    def intrinsics(self, known: Intrinsics | None, width: int, height: int) -> Intrinsics | None:
        """See :meth:`Geometry.intrinsics`; a rotated image has none of these models."""
        return None


@dataclass(frozen=True)
class Crop:
    """A part of an image, by its upper left corner and its size."""

    left: int
    top: int
    width: int
    height: int

    def size(self, width: int, height: int) -> tuple[int, int]:
        """See :meth:`Geometry.size`."""
        return self.width, self.height

    def origins(self, x: Array, y: Array, width: int, height: int) -> tuple[Array, Array]:
        """See :meth:`Geometry.origins`."""
        return x + self.left, y + self.top

    def intrinsics(self, known: Intrinsics | None, width: int, height: int) -> Intrinsics | None:
        """See :meth:`Geometry.intrinsics`."""
        if known is None:
            return None
        cx, cy = known.cx - self.left, known.cy - self.top
        return replace(known, width=self.width, height=self.height, cx=cx, cy=cy)


RESIDUAL = 1e-6  # px in the input of a geometry; the largest error of an inverted position
STEP = 1e-3  # px; the step of finite differences
ITERATIONS = 20


def destinations(
    geometry: Geometry,
    to: tuple[Array, Array],
    start: tuple[Array, Array],
    width: int,
    height: int,
    at: tuple[Array, Array] | None = None,
) -> tuple[Array, Array]:
    """Return the positions in a geometry's output for positions of its input: inverse of origins.

    Newton's method in two dimensions, the Jacobian by finite differences, until a position's origin
    has an error below :data:`RESIDUAL`. A :class:`ForwardMapped` geometry computes it directly.

    Args:
        geometry: how the pixels move.
        to: x and y of the positions, float64 of any shape.
        start: positions of the output nearby, of the same shape.
        width: the width of the input in px.
        height: its height in px.
        at: see :meth:`ForwardMapped.destinations`; None is the positions themselves.

    Returns:
        x and y; NaN if no position is found, for example beyond the radius where a lens folds.

    >>> import numpy as np
    >>> mirror, start = Orientation(True, False, False), (np.zeros(1), np.zeros(1))
    >>> x, y = destinations(mirror, (np.array([1.0]), np.array([2.0])), start, 8, 6)
    >>> x.round(6).tolist(), y.round(6).tolist()
    ([7.0], [2.0])
    """
    parts = geometry.parts if isinstance(geometry, Composition) else (geometry,)
    if parts and isinstance(parts[0], ForwardMapped):
        first = parts[0].destinations(*to, at or to, width, height)
        size = parts[0].size(width, height)
        return destinations(Composition(parts[1:]), first, start, *size) if parts[1:] else first
    shape = to[0].shape
    targets = np.stack([np.ravel(each) for each in to]).astype(np.float64)
    found = np.stack([np.ravel(each) for each in start]).astype(np.float64)
    result = np.full_like(found, np.nan)
    right, down = np.array([[STEP], [0]]), np.array([[0], [STEP]])

    def origins(positions: Array) -> Array:
        return np.stack(geometry.origins(positions[0], positions[1], width, height))

    remaining = np.flatnonzero(np.isfinite(targets).all(0))
    targets, found = targets[:, remaining], found[:, remaining]
    with np.errstate(all="ignore"):  # diverging positions become NaN
        for _ in range(ITERATIONS):
            current = origins(found)
            error = targets - current
            converged = np.hypot(error[0], error[1]) <= RESIDUAL
            result[:, remaining[converged]] = found[:, converged]
            unconverged = ~converged & np.isfinite(error).all(0)
            remaining, targets, found = (
                remaining[unconverged],
                targets[:, unconverged],
                found[:, unconverged],
            )
            if not remaining.size:
                break
            current, error = current[:, unconverged], error[:, unconverged]
            by_x = (origins(found + right) - current) / STEP
            by_y = (origins(found + down) - current) / STEP
            determinant = by_x[0] * by_y[1] - by_x[1] * by_y[0]
            found = found + np.stack(
                [
                    (error[0] * by_y[1] - error[1] * by_y[0]) / determinant,
                    (error[1] * by_x[0] - error[0] * by_x[1]) / determinant,
                ]
            )
    return result[0].reshape(shape), result[1].reshape(shape)
