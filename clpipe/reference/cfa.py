"""The Bayer patterns, like in ``kernels/lib/cfa.h``."""

from collections import Counter
from typing import Literal, get_args

import numpy as np

from clpipe.base.types import Floats

Pattern = Literal["RGGB", "BGGR", "GRBG", "GBRG"]
PATTERNS: tuple[Pattern, ...] = get_args(Pattern)


def red_site(pattern: str) -> tuple[int, int]:
    """Column and row (each 0 or 1) of red in the 2x2 cell; the pattern spells the cell by rows.

    >>> red_site("GRBG")
    (1, 0)
    """
    return pattern.index("R") % 2, pattern.index("R") // 2


def sites(pattern: str) -> dict[str, tuple[slice, slice]]:
    """Return the rows and columns of R, G1, G2 and B in a mosaic; G1 is in the rows of red.

    For an array that is no Bayer pattern, in rows of letters, each position of its period.

    >>> sites("GRBG")["R"]
    (slice(0, None, 2), slice(1, None, 2))
    >>> list(sites("RW/WB")), sites("L")["L"]
    (['R', 'W1', 'W2', 'B'], (slice(0, None, 1), slice(0, None, 1)))
    """
    if pattern not in PATTERNS:
        rows = pattern.split("/")
        count = Counter("".join(rows))
        counter: Counter[str] = Counter()
        found = {}
        for y, row in enumerate(rows):
            for x, letter in enumerate(row):
                counter[letter] += 1
                name = f"{letter}{counter[letter]}" if count[letter] > 1 else letter
                found[name] = np.s_[y :: len(rows), x :: len(row)]
        return found
    x, y = red_site(pattern)
    positions = {"R": (y, x), "G1": (y, 1 - x), "G2": (1 - y, x), "B": (1 - y, 1 - x)}
    return {name: np.s_[row::2, column::2] for name, (row, column) in positions.items()}


def by_site(
    shape: tuple[int, ...],
    pattern: Pattern,
    red: Floats | np.float32,
    green: Floats | np.float32,
    blue: Floats | np.float32,
) -> Floats:
    """Return at each pixel the value for the colour of that site; (height, width).

    ``shape`` begins with height and width. Red, green and blue are each one value, or an image of
    that height and width.

    >>> by_site((2, 2), "RGGB", np.float32(1), np.float32(2), np.float32(3)).tolist()
    [[1.0, 2.0], [2.0, 3.0]]
    """
    red_x, red_y = red_site(pattern)
    in_red_row = ((np.arange(shape[0]) ^ red_y) & 1 == 0)[:, None]
    in_red_column = ((np.arange(shape[1]) ^ red_x) & 1 == 0)[None, :]
    return np.where(
        in_red_row, np.where(in_red_column, red, green), np.where(in_red_column, green, blue)
    ).astype(np.float32)
