"""Where in a picture patches are cut, how they are turned, and how samples are numbered. Pure."""

from bisect import bisect_right
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import lru_cache
from itertools import accumulate
from typing import Literal

import numpy as np

from clpipe.base.errors import ImageError
from clpipe.base.types import Array
from clpipe.chain.drawing import uniforms
from clpipe.engine.extents import Box
from clpipe.images.tags import FLIPS, upright
from clpipe.reference.cfa import Pattern

TOGETHER = 64  # patches of an image that are developed at a time


@dataclass(frozen=True)
class Patch:
    """A square part of a picture.

    Args:
        left, top: its first column and row in the picture.
        size: of its sides, in px.
        turn: how it is turned when it has been cut out: one of EXIF's eight orientations, each of
            which is a flip, a turn by a multiple of 90 degrees, or both; 1 is none.
    """

    left: int
    top: int
    size: int
    turn: int = 1

    @property
    def box(self) -> Box:
        """The part of the picture."""
        return Box(self.left, self.top, self.left + self.size, self.top + self.size)

    def cut_out(self, image: Array) -> Array:
        """It, turned, from a whole image, (height, width[, channel])."""
        box = self.box
        return self.turned(image[box.top : box.bottom, box.left : box.right])

    def turned(self, part: Array) -> Array:
        """That part of an image, turned; C-contiguous."""
        return upright(part, self.turn)


@lru_cache(maxsize=64)
def first_place(pattern: Pattern, turn: int, size: int) -> tuple[int, int]:
    """The first column and row, each 0 or 1, of a patch that has the pattern when it is turned.

    So a mosaic keeps its pattern, and no pixel is interpolated or thrown away: the CFA-preserving
    augmentation of Liu et al., "Learning Raw Image Denoising with Bayer Pattern Unification and
    Bayer Preserving Augmentation" (CVPR workshops 2019), who crop a pixel after the flip instead.

    >>> first_place("RGGB", 2, 128), first_place("GRBG", 5, 128)  # left to right; transposed
    ((1, 0), (1, 1))
    """
    cell = np.array(list(pattern)).reshape(2, 2)
    side = 2 + size % 2
    places = ((x, y) for y in (0, 1) for x in (0, 1))
    return next(
        (x, y)
        for x, y in places
        if (upright(np.tile(cell, (2, 2))[y:, x:][:side, :side], turn)[:2, :2] == cell).all()
    )


@dataclass(frozen=True)
class Cutting:
    """How patches are cut from the pictures of one size and CFA pattern.

    Each begins so that, turned, it has the pattern of the camera.

    Args:
        size: of the sides of a patch, in px.
        width, height: of the picture, at least as large.
        pattern: of its mosaic.
        augment: whether patches are flipped and turned.
    """

    size: int
    width: int
    height: int
    pattern: Pattern
    augment: bool

    def drawn(self, numbers: Sequence[int], owner: str) -> list[Patch]:
        """Patches at random places, by their numbers.

        ``owner`` is what they belong to, see :func:`~clpipe.chain.drawing.uniforms`.
        """
        draws = self._draws(numbers, owner, ("turn", "left", "top"))
        patches = []
        for u_turn, u_left, u_top in draws:
            turn = self._turn(u_turn)
            x, y = first_place(self.pattern, turn, self.size)
            left = x + 2 * int(u_left * ((self.width - self.size - x) // 2 + 1))
            top = y + 2 * int(u_top * ((self.height - self.size - y) // 2 + 1))
            patches.append(Patch(left, top, self.size, turn))
        return patches

    @property
    def count(self) -> int:
        """How many patches side by side cover a picture, but for a last odd column and row."""
        return self._columns * -(-self.height // self.size)

    def in_grid(self, numbers: Sequence[int], owner: str) -> list[Patch]:
        """Some of these, by their numbers, row by row; the last of a row or column ends with it.

        They are moved by up to a pixel where their turns want that. ``owner`` as for :meth:`drawn`.
        """
        patches = []
        for number, (u_turn,) in zip(numbers, self._draws(numbers, owner, ("turn",)), strict=True):
            row, column = divmod(number, self._columns)
            turn = self._turn(u_turn)
            x, y = first_place(self.pattern, turn, self.size)
            left = min(column * self.size, self.width - self.size)
            top = min(row * self.size, self.height - self.size)
            left, top = max(left - (left - x) % 2, x), max(top - (top - y) % 2, y)
            patches.append(Patch(left, top, self.size, turn))
        return patches

    @staticmethod
    def _draws(
        numbers: Sequence[int], owner: str, names: Sequence[str]
    ) -> Iterator[tuple[float, ...]]:
        """Numbers from 0 to 1 for each patch, by its number and their names."""
        drawn = uniforms(owner, [f"{number}.{name}" for number in numbers for name in names])
        return (tuple(drawn[f"{number}.{name}"] for name in names) for number in numbers)

    @property
    def _columns(self) -> int:
        return -(-self.width // self.size)

    def _turn(self, number: float) -> int:
        """The turn of a number from 0 to 1, of those for which there is a place."""
        if not self.augment:
            return 1
        room = self.width - self.size, self.height - self.size
        fits = [
            turn
            for turn in FLIPS
            if all(np.less_equal(first_place(self.pattern, turn, self.size), room))
        ]
        return fits[int(number * len(fits))]


@dataclass(frozen=True)
class Patches:
    """Which patches are cut of each picture.

    Args:
        size: of their sides, in px.
        per_image: how many, at random places; "grid" is all that cover the picture.
        augment: whether they are flipped and turned.
    """

    size: int
    per_image: int | Literal["grid"]
    augment: bool

    def cutting(self, width: int, height: int, pattern: Pattern) -> Cutting:
        """How they are cut of a picture.

        Raises:
            ImageError: it is smaller than a patch.
        """
        if self.size > min(width, height):
            raise ImageError(
                f"its picture has {width}x{height} pixels, and patches are to have "
                f"{self.size}x{self.size}; make them smaller, or leave the image out"
            )
        return Cutting(self.size, width, height, pattern, self.augment)

    def cut(self, cutting: Cutting, numbers: Sequence[int], owner: str) -> list[Patch]:
        """Some of them, by their numbers; ``owner`` as for :meth:`Cutting.drawn`."""
        cut = cutting.in_grid if self.per_image == "grid" else cutting.drawn
        return cut(numbers, owner)


class Numbering:
    """The numbers of samples: image after image, epoch after epoch.

    Args:
        counts: how many samples there are of each image.

    >>> numbering = Numbering([2, 3])
    >>> numbering.place(4), numbering.place(5), next(numbering.groups(1))
    ((0, 1, 2), (1, 0, 0), (0, 0, range(1, 2)))
    """

    def __init__(self, counts: Sequence[int]) -> None:
        self._ends = list(accumulate(counts, initial=0))

    @property
    def of_epoch(self) -> int:
        """How many samples an epoch has."""
        return self._ends[-1]

    def place(self, number: int) -> tuple[int, int, int]:
        """Epoch, image, and number within the image of a sample; each counts from 0."""
        epoch, rest = divmod(number, self.of_epoch)
        image = bisect_right(self._ends, rest) - 1
        return epoch, image, rest - self._ends[image]

    def groups(self, first: int) -> Iterator[tuple[int, int, range]]:
        """All samples from a number on, those of an image at most :data:`TOGETHER` at a time.

        It does not end.
        """
        epoch, image, begin = self.place(first)
        while True:
            count = self._ends[image + 1] - self._ends[image]
            if begin < count:
                yield epoch, image, range(begin, min(begin + TOGETHER, count))
                begin += TOGETHER
            else:
                begin, image = 0, image + 1
                if image == len(self._ends) - 1:
                    epoch, image = epoch + 1, 0
