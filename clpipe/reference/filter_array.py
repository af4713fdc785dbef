"""Colour filter arrays of any period: a table of channels, and the response of each of them.

The four Bayer patterns are in :mod:`clpipe.reference.cfa`; their kernels have them built in.
"""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache

import numpy as np

from clpipe.base.errors import RequestError
from clpipe.base.text import unknown_name
from clpipe.base.types import Array, Doubles, Floats
from clpipe.reference.cfa import PATTERNS, Pattern
from clpipe.reference.image import mirror

MAX_PERIOD = 8
MIRRORED = 2  # the longest period that a mirrored border (reflect-101) continues
# The most lanes that a device has. Each row of a table has as many extra entries, so that it loads
# at once.
LANES = 16

# The raw red, green and blue that pass a filter. Like ideal dyes, clear and two-colour filters pass
# the sum of their colours. The arrays are by Bayer (R, G, B), Yamanaka (US 4,054,906), Compton and
# Hamilton (US 8,139,130), and others. A mono sensor has no filter. An RGB render contains no near
# infrared, so that channel sees a quarter of a clear one.
TRANSMISSIONS: dict[str, tuple[float, ...]] = {
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

# Polarisers, by the angle that passes, in degrees. Linearly polarised light has three components,
# like colour: red, green and blue are the light after polarisers at these other angles (Fessenkov).
# The law of Malus gives the light at any angle. Unpolarised light is gray.
POLARISERS = {"H": 0, "D": 45, "V": 90, "A": 135}
ANGLES = (0, 60, 120)
TRANSMISSIONS |= {
    letter: tuple((1 + 2 * np.cos(np.deg2rad(2 * (angle - own)))) / 3 for own in ANGLES)
    for letter, angle in POLARISERS.items()
}
LETTERS = "".join(TRANSMISSIONS)

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
        name: a name in :data:`NAMED`, or its rows.
        rows: the letters of one period, from :data:`LETTERS`.
        gains: white balance gains of red and blue (green = 1). For white, raw red is 1/gain of
            green.
        is_balanced: whether white is 1 in all channels of the mosaic. Otherwise, its colours are
            the raw ones, and the light that a filter passes is added up.
        whites: the raw signal of each channel for white, in any unit; () is that of ideal dyes.

    A camera exposes for the channel that saturates first. White at EV 0 fills this channel, and the
    others less, by :meth:`levels`. A clear pixel therefore saturates before its neighbours.
    """

    name: str
    rows: tuple[str, ...]
    gains: tuple[float, float] = (1.0, 1.0)
    is_balanced: bool = True
    whites: tuple[float, ...] = ()

    @property
    def period(self) -> tuple[int, int]:
        """The period in rows and columns."""
        return len(self.rows), len(self.rows[0])

    @property
    def pattern(self) -> str:
        """A Bayer pattern, for example "RGGB", or the rows separated by /."""
        return self.bayer or "/".join(self.rows)

    @cached_property
    def bayer(self) -> Pattern | None:
        """Its Bayer pattern; None for another array."""
        joined = "".join(self.rows)
        return next((p for p in PATTERNS if p == joined and len(self.rows) == 2), None)

    @property
    def letters(self) -> Array:
        """One period, (row, column), of single letters."""
        return np.array([list(row) for row in self.rows])

    @cached_property
    def channels(self) -> tuple[str, ...]:
        """Its channels, each once, in the order of :data:`TRANSMISSIONS`."""
        return tuple(letter for letter in TRANSMISSIONS if any(letter in row for row in self.rows))

    @property
    def is_gray(self) -> bool:
        """Whether all pixels have the same response."""
        return len(self.channels) == 1

    @property
    def is_polarised(self) -> bool:
        """Whether its channels are polarisers, without colours."""
        return set(self.channels) <= POLARISERS.keys()

    @property
    def needs_border(self) -> bool:
        """Whether reflect-101 gives a pixel outside the edge another channel than the array."""
        return max(self.period) > MIRRORED

    def with_gains(self, gains: tuple[float, float], is_balanced: bool = True) -> "FilterArray":
        """Return the array of a mosaic whose colours depend on other gains.

        If no channel mixes colours, it is the same object, so its filters are computed once.

        >>> parse_array("x-trans").with_gains((2.0, 1.6)) == parse_array("x-trans")
        True
        """
        mixes = any(np.count_nonzero(TRANSMISSIONS[letter]) > 1 for letter in self.channels)
        if not mixes or self.is_polarised:
            return self
        return replace(self, gains=gains, is_balanced=is_balanced)

    @cached_property
    def responses(self) -> dict[str, Doubles]:
        """Return the response of each channel to the red, green and blue of the mosaic.

        In a balanced array, its sum is 1.

        >>> parse_array("RCCB").with_gains((2.0, 1.6), is_balanced=False).responses["W"].tolist()
        [1.0, 1.0, 1.0]
        """
        if not self.is_balanced:
            return {letter: np.array(TRANSMISSIONS[letter], np.float64) for letter in self.channels}
        raw = {letter: self._raw(letter) for letter in self.channels}
        return {letter: row / row.sum() for letter, row in raw.items()}

    @cached_property
    def levels(self) -> dict[str, float]:
        """Return the raw signal of each channel for white; 1 for the most sensitive one.

        >>> parse_array("x-trans", (2.0, 1.6)).levels
        {'R': 0.5, 'G': 1.0, 'B': 0.625}
        """
        sums = dict(zip(self.channels, self.whites, strict=False)) or {
            letter: float(self._raw(letter).sum()) for letter in self.channels
        }
        largest = max(sums.values())
        return {letter: value / largest for letter, value in sums.items()}

    def _raw(self, letter: str) -> Doubles:
        red, blue = (1.0, 1.0) if letter in POLARISERS else self.gains
        return np.array(TRANSMISSIONS[letter]) / (red, 1.0, blue)

    def by_position(self, values: Mapping[str, float]) -> Floats:
        """Return the value of the channel at each position of a period: (row, column)."""
        found: Floats = np.vectorize(values.__getitem__, [np.float32])(self.letters)
        return found

    def spread(self, values: Mapping[str, float], shape: tuple[int, ...]) -> Floats:
        """Return the value of the channel at each pixel of an image, (height, width)."""
        return tiled(self.by_position(values), shape)


def tiled(period: Floats, shape: tuple[int, ...]) -> Floats:
    """Return an image, (height, width), that repeats a period, (row, column).

    >>> tiled(np.float32([[1, 2], [3, 4]]), (3, 3)).tolist()
    [[1.0, 2.0, 1.0], [3.0, 4.0, 3.0], [1.0, 2.0, 1.0]]
    """
    rows, columns = np.arange(shape[0]) % period.shape[0], np.arange(shape[1]) % period.shape[1]
    return period[np.ix_(rows, columns)]


def kernel_table(values: Floats) -> Floats:
    """Return a table for kernels: each row continues periodically for a vector of lanes.

    Args:
        values: (row, ..., column), a period.

    Returns:
        The table with ``column + LANES`` columns.
    """
    columns = values.shape[-1]
    return np.ascontiguousarray(values[..., np.arange(columns + LANES) % columns])


@lru_cache(maxsize=64)
def parse_array(text: str, gains: tuple[float, float] = (1.0, 1.0)) -> FilterArray:
    """Return the filter array of a name, or of rows of letters separated by slashes.

    >>> parse_array("RGB/GBR/BRG").period
    (3, 3)

    Raises:
        RequestError: there is no such name, a letter is unknown, or rows differ in length.
    """
    rows = tuple(NAMED.get(text, text).split("/"))
    if "/" not in text and text not in NAMED and not set(text) <= {*LETTERS}:
        raise RequestError(
            f"{unknown_name('filter array', text, NAMED)}; or use rows, for example RG/GB"
        )
    unknown = sorted(set("".join(rows)) - {*LETTERS})
    if unknown:
        raise RequestError(f"{text!r} contains {unknown[0]!r}; a channel is one of {LETTERS}")
    lengths = {len(row) for row in rows}
    if len(lengths) > 1 or not 0 < max(lengths) <= MAX_PERIOD or len(rows) > MAX_PERIOD:
        raise RequestError(
            f"found {text!r}; expected rows of the same length, with / between, and at most "
            f"{MAX_PERIOD}x{MAX_PERIOD} letters"
        )
    array = FilterArray(text, rows, gains)
    if not array.is_polarised and POLARISERS.keys() & {*array.channels}:
        raise RequestError(
            f"found {text!r}; polarisers (H, D, V, A) cannot be combined with colours"
        )
    return array


def periodic_indices(size: int, period: int, reach: int) -> Array:
    """Return the pixel to use at each position from ``-reach`` to ``size + reach``.

    Outside an edge, it is the nearest one at a distance of whole periods, so that its channel is
    that of the array. A period of at most 2 is mirrored (reflect-101), which continues it as well.
    So is a side that is shorter than a period.

    >>> periodic_indices(5, 3, 2).tolist(), periodic_indices(2, 3, 2).tolist()
    ([1, 2, 0, 1, 2, 3, 4, 2, 3], [0, 1, 0, 1, 0, 1])
    """
    positions = np.arange(-reach, size + reach)
    if period <= MIRRORED or size < period:
        return mirror(positions, size)
    before = positions % period
    after = positions - period * ((positions - size) // period + 1)
    return np.where(positions < 0, before, np.where(positions >= size, after, positions))
