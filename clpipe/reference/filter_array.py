"""Colour filter arrays of any period: a table of channels, and what each of them sees.

The four Bayer patterns are :mod:`clpipe.reference.cfa`'s; their kernels know them by heart.
"""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache

import numpy as np

from clpipe.base.errors import RequestError
from clpipe.base.text import one_of
from clpipe.base.types import Array, Doubles, Floats
from clpipe.reference.cfa import PATTERNS, Pattern

MAX_PERIOD = 8
MIRRORED = 2  # the longest period that a mirrored border (reflect-101) goes on with
LANES = 16  # the most that a device has: what is behind a row of a table, to be loaded at once

# Which of the raw red, green and blue pass a filter. Clear filters and those of two colours add up
# what the others see, as ideal dyes do (Bayer and others use R, G, B; Yamanaka, US 4,054,906, and
# Compton and Hamilton, US 8,139,130, others). A mono sensor has no filter. An RGB render says
# nothing of near infrared: that channel sees a quarter of what a clear one does.
PASSES: dict[str, tuple[float, ...]] = {
    "R": (1, 0, 0),
    "G": (0, 1, 0),
    "B": (0, 0, 1),
    "W": (1, 1, 1),
    "Y": (1, 1, 0),
    "C": (0, 1, 1),
    "M": (1, 0, 1),
    "I": (0.25, 0.25, 0.25),
    "L": (1, 1, 1),
}

# Polarisers, by the angle that passes, in degrees. Linearly polarised light is three numbers, as
# colour is: red, green and blue are then what polarisers at these other angles pass (Fessenkov).
# What passes at any angle follows from them by the law of Malus; unpolarised light is gray.
POLARISERS = {"H": 0, "D": 45, "V": 90, "A": 135}
ANGLES = (0, 60, 120)
PASSES |= {
    letter: tuple((1 + 2 * np.cos(np.deg2rad(2 * (angle - own)))) / 3 for own in ANGLES)
    for letter, angle in POLARISERS.items()
}
LETTERS = "".join(PASSES)

MONO = "L"  # the pattern of a sensor without filters

NAMED: dict[str, str] = {
    **{pattern: f"{pattern[:2]}/{pattern[2:]}" for pattern in PATTERNS},
    "mono": MONO,
    "RCCB": "RW/WB",
    "RCCC": "RW/WW",
    "RYYB": "RY/YB",
    "RGBW": "WGWR/GWRW/WBWG/BWGW",
    "CMYG": "CM/YG",
    "RGGB-IR": "BGRG/GIGI/RGBG/GIGI",
    "quad-RGGB": "RRGG/RRGG/GGBB/GGBB",
    "nona-RGGB": "RRRGGG/RRRGGG/RRRGGG/GGGBBB/GGGBBB/GGGBBB",
    "polarised": "VD/AH",
    "x-trans": "GBGGRG/RGRBGB/GBGGRG/GRGGBG/BGBRGR/GRGGBG",
}


@dataclass(frozen=True)
class FilterArray:
    """A colour filter array.

    Args:
        name: of :data:`NAMED`, or its rows.
        rows: the letters of one period, of :data:`LETTERS`.
        gains: white balance gains of red and blue (green = 1): raw red of white is 1/gain of green.
        is_balanced: whether white is 1 in all channels of the mosaic; otherwise its colours are the
            raw ones, and what a filter passes adds up.

    A camera exposes for the channel that saturates first: white at EV 0 fills it, and the others
    less, by :meth:`levels`. So a clear pixel saturates while its neighbours have room.
    """

    name: str
    rows: tuple[str, ...]
    gains: tuple[float, float] = (1.0, 1.0)
    is_balanced: bool = True

    @property
    def period(self) -> tuple[int, int]:
        """After how many rows and columns it repeats."""
        return len(self.rows), len(self.rows[0])

    @property
    def pattern(self) -> str:
        """A Bayer pattern, such as "RGGB", or the rows with / between."""
        return self.bayer or "/".join(self.rows)

    @cached_property
    def bayer(self) -> Pattern | None:
        """Its Bayer pattern; None where it is another array."""
        joined = "".join(self.rows)
        return next((p for p in PATTERNS if p == joined and len(self.rows) == 2), None)

    @property
    def letters(self) -> Array:
        """One period, (row, column), of single letters."""
        return np.array([list(row) for row in self.rows])

    @cached_property
    def channels(self) -> tuple[str, ...]:
        """Its channels, each once, in the order of :data:`PASSES`."""
        return tuple(letter for letter in PASSES if any(letter in row for row in self.rows))

    @property
    def is_gray(self) -> bool:
        """Whether all pixels see the same."""
        return len(self.channels) == 1

    @property
    def is_polarised(self) -> bool:
        """Whether its channels are polarisers, without colours."""
        return set(self.channels) <= POLARISERS.keys()

    @property
    def needs_border(self) -> bool:
        """Whether reflect-101 gives a pixel beyond the edge another channel than the array has."""
        return max(self.period) > MIRRORED

    def with_gains(self, gains: tuple[float, float], is_balanced: bool = True) -> "FilterArray":
        """The array of a mosaic whose colours depend on other gains.

        It is the same where no channel mixes colours, so its filters are computed once.

        >>> parse_array("x-trans").with_gains((2.0, 1.6)) == parse_array("x-trans")
        True
        """
        mixes = any(np.count_nonzero(PASSES[letter]) > 1 for letter in self.channels)
        if not mixes or self.is_polarised:
            return self
        return replace(self, gains=gains, is_balanced=is_balanced)

    @cached_property
    def responses(self) -> dict[str, Doubles]:
        """What each channel sees of red, green and blue as they are in the mosaic.

        The sum is 1 in a balanced one.

        >>> parse_array("RCCB").with_gains((2.0, 1.6), is_balanced=False).responses["W"].tolist()
        [1.0, 1.0, 1.0]
        """
        if not self.is_balanced:
            return {letter: np.array(PASSES[letter], np.float64) for letter in self.channels}
        raw = {letter: self._raw(letter) for letter in self.channels}
        return {letter: row / row.sum() for letter, row in raw.items()}

    @cached_property
    def levels(self) -> dict[str, float]:
        """The raw signal of each channel in a white that fills the most sensitive one: at most 1.

        >>> parse_array("x-trans", (2.0, 1.6)).levels
        {'R': 0.5, 'G': 1.0, 'B': 0.625}
        """
        sums = {letter: float(self._raw(letter).sum()) for letter in self.channels}
        largest = max(sums.values())
        return {letter: value / largest for letter, value in sums.items()}

    def _raw(self, letter: str) -> Doubles:
        red, blue = (1.0, 1.0) if letter in POLARISERS else self.gains
        return np.array(PASSES[letter]) / (red, 1.0, blue)

    def by_place(self, values: Mapping[str, float]) -> Floats:
        """At each place of a period, the value of its channel: (row, column)."""
        found: Floats = np.vectorize(values.__getitem__, [np.float32])(self.letters)
        return found

    def spread(self, values: Mapping[str, float], shape: tuple[int, ...]) -> Floats:
        """At each pixel of an image, (height, width), the value of its channel."""
        return tiled(self.by_place(values), shape)


def tiled(period: Floats, shape: tuple[int, ...]) -> Floats:
    """An image, (height, width), that repeats a period, (row, column).

    >>> tiled(np.float32([[1, 2], [3, 4]]), (3, 3)).tolist()
    [[1.0, 2.0, 1.0], [3.0, 4.0, 3.0], [1.0, 2.0, 1.0]]
    """
    rows, columns = np.arange(shape[0]) % period.shape[0], np.arange(shape[1]) % period.shape[1]
    return period[np.ix_(rows, columns)]


def kernel_table(values: Floats) -> Floats:
    """A table as kernels load it: each row goes on periodically for a vector of lanes.

    Args:
        values: (row, ..., column), a period.

    Returns:
        The same with ``column + LANES`` columns.
    """
    columns = values.shape[-1]
    return np.ascontiguousarray(values[..., np.arange(columns + LANES) % columns])


@lru_cache(maxsize=64)
def parse_array(text: str, gains: tuple[float, float] = (1.0, 1.0)) -> FilterArray:
    """The filter array of a name, or of rows of letters with a slash between.

    >>> parse_array("RGB/GBR/BRG").period
    (3, 3)

    Raises:
        RequestError: there is no such name, a letter is unknown, or rows differ in length.
    """
    rows = tuple(NAMED.get(text, text).split("/"))
    if "/" not in text and text not in NAMED and not set(text) <= {*LETTERS}:
        raise RequestError(f"{one_of('filter array', text, NAMED)}; or rows, such as RG/GB")
    unknown = sorted(set("".join(rows)) - {*LETTERS})
    if unknown:
        raise RequestError(f"found {text!r}, with {unknown[0]!r}; a channel is one of {LETTERS}")
    lengths = {len(row) for row in rows}
    if len(lengths) > 1 or not 0 < max(lengths) <= MAX_PERIOD or len(rows) > MAX_PERIOD:
        raise RequestError(
            f"found {text!r}; expected rows of one length, with / between, and at most "
            f"{MAX_PERIOD}x{MAX_PERIOD} letters"
        )
    array = FilterArray(text, rows, gains)
    if not array.is_polarised and POLARISERS.keys() & {*array.channels}:
        raise RequestError(f"found {text!r}; polarisers (H, D, V, A) do not go with colours")
    return array


def beyond(size: int, period: int, reach: int) -> Array:
    """For each place from ``-reach`` to ``size + reach``, the pixel that stands for it.

    Beyond an edge it is the nearest one in whole periods, so that it has the channel that the array
    has there. Mirrored (reflect-101) are a period of at most 2, which goes on so, too, and a side
    that is shorter than a period.

    >>> beyond(5, 3, 2).tolist(), beyond(2, 3, 2).tolist()
    ([1, 2, 0, 1, 2, 3, 4, 2, 3], [0, 1, 0, 1, 0, 1])
    """
    place = np.arange(-reach, size + reach)
    if period <= MIRRORED or size < period:
        around = max(2 * (size - 1), 1)
        within = place % around
        return np.asarray(np.where(within < size, within, around - within))
    before = place % period
    behind = place - period * ((place - size) // period + 1)
    return np.where(place < 0, before, np.where(place >= size, behind, place))
