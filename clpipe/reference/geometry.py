"""Where the pixels of a picture come from: how stages move what they show, for all that goes along.

Places are counted in pixels from the image's upper left corner, so that the centre of the first
pixel is at (0.5, 0.5), as COLMAP counts; OpenCV's first centre is (0, 0).
"""

from dataclasses import dataclass
from typing import Protocol

from clpipe.base.types import Array
from clpipe.reference.resample import Resampling, sizes


class Geometry(Protocol):
    """How a stage moves the pixels of an image of some width and height, in px."""

    def size(self, width: int, height: int) -> tuple[int, int]:
        """The width and height of what it gives, from those of what it gets."""
        ...

    def origins(self, x: Array, y: Array, width: int, height: int) -> tuple[Array, Array]:
        """Where places of its result come from in the image that it gets; float64 of any shape.

        For a lens with lateral colour these are the places of green. Places may lie outside the
        image, where nothing is known.

        Args:
            x, y: places in the result.
            width, height: of the image that it gets.
        """
        ...


@dataclass(frozen=True)
class Scaling:
    """Rows and columns made fewer; the edges stay where they are.

    >>> import numpy as np
    >>> from clpipe.reference.resample import overlap
    >>> half = Scaling((Resampling("columns", 0.5, overlap, 0.5),))
    >>> half.size(8, 6), half.origins(np.array(0.5), np.array(0.5), 8, 6)
    ((4, 6), (np.float64(1.0), np.float64(0.5)))
    """

    resamplings: tuple[Resampling, ...]

    def size(self, width: int, height: int) -> tuple[int, int]:
        """See :meth:`Geometry.size`."""
        return sizes(self.resamplings, width, height)[-1]

    def origins(self, x: Array, y: Array, width: int, height: int) -> tuple[Array, Array]:
        """See :meth:`Geometry.origins`."""
        columns, rows = self.size(width, height)
        return x * (width / columns), y * (height / rows)
