"""Places of a picture that are worth a closer look: named by hand, or found."""

import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from clpipe.analysis.signature import luma
from clpipe.base.errors import RequestError
from clpipe.base.types import Array, Doubles, Floats, Mask

WIDTH, HEIGHT = 96, 64  # px, of a place that is found
SMOOTH = 5  # px, the window over which noise is averaged before places are looked for
MIDDLE = 0.2, 0.8  # display values between which a flat place is, in the mean
BLACK = 0.08  # display value of luma; what is darker shows nothing,
MOST_BLACK = 0.05  # and is at most this share of a dark place

BY_HAND = re.compile(r"(?:(?P<name>[^=]+)=)?(?P<box>\d{1,9},\d{1,9},\d{1,9}x\d{1,9})")


@dataclass(frozen=True)
class Place:
    """A rectangle of a picture, px, and what it is called."""

    name: str
    left: int
    top: int
    width: int
    height: int

    @property
    def box(self) -> str:
        """Where it is, as it is given by hand.

        >>> Place("sky", 10, 20, 96, 64).box
        '10,20,96x64'
        """
        return f"{self.left},{self.top},{self.width}x{self.height}"

    def of(self, image: Array) -> Array:
        """The part of an image that lies there, (height, width[, channel])."""
        return image[self.top : self.top + self.height, self.left : self.left + self.width]

    def within(self, width: int, height: int) -> bool:
        """Whether all of it is inside an image of this size, and it is not empty."""
        right, bottom = self.left + self.width, self.top + self.height
        return min(self.width, self.height) > 0 and right <= width and bottom <= height


def choose_places(texts: Sequence[str], picture: Floats) -> list[Place]:
    """The places that are asked for, in their order; of none, one of each of :data:`FOUND`.

    Args:
        texts: each ``X,Y,WxH`` (px from the left and the top), with ``NAME=`` before it or not, or
            a name of :data:`FOUND`.
        picture: (height, width, 3), display values, in which places are found; the less noise, the
            better.

    Raises:
        RequestError: a text is neither, or its place is not in the picture.

    >>> choose_places(["sky=10,20,30x40", "0,0,2x2"], np.zeros((99, 99, 3), np.float32))[0]
    Place(name='sky', left=10, top=20, width=30, height=40)
    """
    height, width = picture.shape[:2]
    finder = _Finder(picture)
    places = []
    for text in texts or FOUND:
        if text in FOUND:
            if width < WIDTH or height < HEIGHT:
                raise RequestError(
                    f"--crop {text}: the pictures are {width}x{height}, smaller than the "
                    f"{WIDTH}x{HEIGHT} of a place that is found; name places by hand, such as "
                    f"--crop 0,0,{width}x{height}"
                )
            places.append(finder.find(text))
            continue
        match = BY_HAND.fullmatch(text)
        if match is None:
            raise RequestError(
                f"--crop: found {text!r}; expected X,Y,WxH in pixels from the left and the top, "
                f"such as 120,80,96x64 or sky=120,80,96x64, or one of {', '.join(FOUND)}"
            )
        place = Place(match["name"] or match["box"], *map(int, re.split("[,x]", match["box"])))
        if not place.within(width, height):
            raise RequestError(
                f"--crop {text}: it is empty or reaches beyond the pictures, which are "
                f"{width}x{height}"
            )
        places.append(place)
    return places


def flat(picture: Floats) -> Doubles:
    """The flattest: the variance of R, G and B is least, at a middle brightness."""
    variance = np.asarray(
        sum(window_means(plane**2) - window_means(plane) ** 2 for plane in _planes(picture))
    )
    light = window_means(luma(picture))
    low, high = MIDDLE
    return _only(-variance, (low <= light) & (light <= high))


def textured(picture: Floats) -> Doubles:
    """The richest in detail: the gradient of luma is largest in the mean."""
    return window_means(np.hypot(*np.gradient(luma(picture))))


def saturated(picture: Floats) -> Doubles:
    """The most colourful: the largest of R, G and B is furthest above the smallest."""
    return window_means(np.ptp(picture, axis=2).astype(np.float64))


def dark(picture: Floats) -> Doubles:
    """The darkest that is hardly anywhere black."""
    light = luma(picture)
    return _only(-window_means(light), window_means(light < BLACK) <= MOST_BLACK)


# How good each place is for what is looked for, by the place of its upper left corner.
FOUND: Mapping[str, Callable[[Floats], Doubles]] = {
    function.__name__: function for function in (flat, textured, saturated, dark)
}


class _Finder:
    """Finds places in one picture, each beside those before it where there is room."""

    def __init__(self, picture: Floats) -> None:
        self._picture = picture
        self._smooth: Floats | None = None
        self._free: Mask | None = None

    def find(self, name: str) -> Place:
        if self._smooth is None or self._free is None:
            from scipy import ndimage

            self._smooth = ndimage.uniform_filter(self._picture, (SMOOTH, SMOOTH, 1))
            height, width = self._picture.shape[:2]
            self._free = np.ones((height - HEIGHT + 1, width - WIDTH + 1), bool)
        score = _only(FOUND[name](self._smooth), self._free)
        top, left = map(int, np.unravel_index(score.argmax(), score.shape))
        self._free[
            max(top - HEIGHT + 1, 0) : top + HEIGHT, max(left - WIDTH + 1, 0) : left + WIDTH
        ] = False
        return Place(name, left, top, WIDTH, HEIGHT)


def window_means(plane: Doubles | Mask) -> Doubles:
    """The mean of a plane over each place, by its upper left corner: (height - 63, width - 95).

    >>> window_means(np.ones((65, 99))).shape
    (2, 4)
    """
    total = np.pad(plane.cumsum(0).cumsum(1), ((1, 0), (1, 0)))
    rows = total[HEIGHT:] - total[:-HEIGHT]
    return np.asarray((rows[:, WIDTH:] - rows[:, :-WIDTH]) / (HEIGHT * WIDTH))


def _planes(picture: Floats) -> Iterator[Doubles]:
    return (picture[..., channel].astype(np.float64) for channel in range(3))


def _only(score: Doubles, allowed: Mask) -> Doubles:
    """The score of what is allowed; of all where nothing is."""
    return np.where(allowed, score, -np.inf) if np.isfinite(score[allowed]).any() else score
