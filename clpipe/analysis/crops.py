"""Chooses crops of a picture: given by the user, or found automatically."""

import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from clpipe.base.errors import RequestError
from clpipe.base.types import Array, Doubles, Floats, Mask
from clpipe.reference.colour import luma

WIDTH, HEIGHT = 96, 64  # px; the size of an automatic crop
SMOOTH = 5  # px: the window over which noise is averaged before the search
MIDDLE = 0.2, 0.8  # the range of a flat crop's mean display value
BLACK = 0.08  # display value of luma below which nothing is visible
MAX_BLACK = 0.05  # the largest share of pixels below BLACK in a dark crop

MANUAL = re.compile(r"(?:(?P<name>[^=]+)=)?(?P<box>\d{1,9},\d{1,9},\d{1,9}x\d{1,9})")


@dataclass(frozen=True)
class Crop:
    """A named rectangle of a picture, in px."""

    name: str
    left: int
    top: int
    width: int
    height: int

    @property
    def box(self) -> str:
        """Its position and size, in the format of --crop.

        >>> Crop("sky", 10, 20, 96, 64).box
        '10,20,96x64'
        """
        return f"{self.left},{self.top},{self.width}x{self.height}"

    def of(self, image: Array) -> Array:
        """Return this part of an image, (height, width[, channel])."""
        return image[self.top : self.top + self.height, self.left : self.left + self.width]

    def within(self, width: int, height: int) -> bool:
        """Return whether it is not empty, and inside an image of this size in px."""
        right, bottom = self.left + self.width, self.top + self.height
        return min(self.width, self.height) > 0 and right <= width and bottom <= height


def choose_crops(texts: Sequence[str], picture: Floats) -> list[Crop]:
    """Return the requested crops in order; without any, one of each kind in :data:`FOUND`.

    Args:
        texts: ``X,Y,WxH`` (px from the left and the top), ``NAME=X,Y,WxH``, or a kind in
            :data:`FOUND`.
        picture: display values, (height, width, 3), in which crops are found. Noise disturbs the
            search.

    Raises:
        RequestError: a text has another form, or its rectangle exceeds the picture.

    >>> choose_crops(["sky=10,20,30x40", "0,0,2x2"], np.zeros((99, 99, 3), np.float32))[0]
    Crop(name='sky', left=10, top=20, width=30, height=40)
    """
    height, width = picture.shape[:2]
    finder: _Finder | None = None
    places = []
    for text in texts or FOUND:
        if text in FOUND:
            if width < WIDTH or height < HEIGHT:
                raise RequestError(
                    f"--crop {text}: the pictures are {width}x{height}, but an automatic crop "
                    f"needs {WIDTH}x{HEIGHT}; set the crop yourself, such as --crop "
                    f"0,0,{width}x{height}"
                )
            finder = finder or _Finder(picture)
            places.append(finder.find(text))
            continue
        match = MANUAL.fullmatch(text)
        if match is None:
            raise RequestError(
                f"--crop: found {text!r}; expected X,Y,WxH in pixels from the left and the top, "
                f"such as 120,80,96x64 or sky=120,80,96x64, or one of {', '.join(FOUND)}"
            )
        place = Crop(match["name"] or match["box"], *map(int, re.split("[,x]", match["box"])))
        if not place.within(width, height):
            raise RequestError(
                f"--crop {text}: this crop is empty or extends outside the pictures; choose a "
                f"crop inside {width}x{height} pixels"
            )
        places.append(place)
    return places


def flat(picture: Floats) -> Doubles:
    """Score flat places: low variance of R, G and B, at a medium brightness."""
    planes = np.moveaxis(picture.astype(np.float64), -1, 0)
    variance = np.sum([window_means(p**2) - window_means(p) ** 2 for p in planes], axis=0)
    light = window_means(luma(picture))
    low, high = MIDDLE
    return _only(-variance, (low <= light) & (light <= high))


def textured(picture: Floats) -> Doubles:
    """Score places with detail: a large mean gradient of luma."""
    return window_means(np.hypot(*np.gradient(luma(picture))))


def saturated(picture: Floats) -> Doubles:
    """Score colourful places: a large range of R, G and B."""
    return window_means(np.ptp(picture, axis=2).astype(np.float64))


def dark(picture: Floats) -> Doubles:
    """Score dark places that are hardly anywhere black."""
    light = luma(picture)
    return _only(-window_means(light), window_means(light < BLACK) <= MAX_BLACK)


# For each kind of crop, a function that scores the crop at each upper left corner.
FOUND: Mapping[str, Callable[[Floats], Doubles]] = {
    function.__name__: function for function in (flat, textured, saturated, dark)
}


class _Finder:
    """Finds crops in one picture that do not overlap earlier ones, if there is space."""

    def __init__(self, picture: Floats) -> None:
        from scipy import ndimage

        self._smooth: Floats = ndimage.uniform_filter(picture, (SMOOTH, SMOOTH, 1))
        height, width = picture.shape[:2]
        self._free = np.ones((height - HEIGHT + 1, width - WIDTH + 1), bool)

    def find(self, name: str) -> Crop:
        score = _only(FOUND[name](self._smooth), self._free)
        top, left = map(int, np.unravel_index(score.argmax(), score.shape))
        self._free[
            max(top - HEIGHT + 1, 0) : top + HEIGHT, max(left - WIDTH + 1, 0) : left + WIDTH
        ] = False
        return Crop(name, left, top, WIDTH, HEIGHT)


def window_means(plane: Doubles | Mask) -> Doubles:
    """Return the mean of a plane in the crop at each corner: (height - 63, width - 95).

    >>> window_means(np.ones((65, 99))).shape
    (2, 4)
    """
    total = np.pad(plane.cumsum(0, np.float64).cumsum(1), ((1, 0), (1, 0)))
    rows = total[HEIGHT:] - total[:-HEIGHT]
    return np.asarray((rows[:, WIDTH:] - rows[:, :-WIDTH]) / (HEIGHT * WIDTH))


def _only(score: Doubles, allowed: Mask) -> Doubles:
    """Return the score with places that are not allowed excluded, unless this excludes all."""
    return np.where(allowed, score, -np.inf) if np.isfinite(score[allowed]).any() else score
