"""Linear demosaicing for any filter array: the best linear estimate under a model of images.

After Trussell and Hartley, "Primary demosaicing using Kodak cameras" (ICIP 2002), and Portilla,
Otaduy and Dorronsoro, "Low-complexity linear demosaicing using joint spatial-chromatic image
statistics" (ICIP 2005): of each place of the period, the filters that leave the least mean square
error. The statistics are a model's here, so that they are there for any array.
"""

from collections.abc import Iterator
from functools import lru_cache

import numpy as np

from clpipe.base.types import Doubles, Floats
from clpipe.reference.filter_array import FilterArray, beyond

RADIUS = 3  # px: windows of 7x7
SIDE = 2 * RADIUS + 1
# The model: luma, the same in red, green and blue, of variance 1, and chroma, whose sum is zero, of
# variance CHROMA for each; both isotropic, with a correlation of NEIGHBOURS to the power of the
# distance in px. Chosen on eight of the Kodak set, RGGB, quad and X-Trans (docs/quality.md).
NEIGHBOURS = 0.95
CHROMA = 0.05
NOISE = 1e-4  # the variance of what the model leaves out


@lru_cache(maxsize=16)
def filters(array: FilterArray) -> Floats:
    """The filters of an array: (row, column, tap, channel) float32; taps go along rows of 7x7.

    They keep a sample of red, green or blue, and leave a flat colour as it is; of an array that
    cannot tell all colours, flat gray.
    """
    between, centre = (NEIGHBOURS ** np.hypot(*apart) for apart in distances())
    rows, columns = array.period
    made = np.zeros((rows, columns, SIDE**2, 3), np.float32)
    for row, column, seen in windows(array):
        made[row, column] = best(seen, between, centre, CHROMA, NOISE)
    return made


def distances() -> tuple[Doubles, Doubles]:
    """How far apart two taps of a window are, and a tap and the centre, in x and y.

    Both in px: (2, tap, tap) and (2, tap).
    """
    span = np.arange(-RADIUS, RADIUS + 1.0)
    x, y = np.tile(span, SIDE), np.repeat(span, SIDE)
    places = np.stack([x, y])
    return places[:, :, None] - places[:, None], places


def windows(array: FilterArray) -> Iterator[tuple[int, int, Doubles]]:
    """Each place of an array's period: its row, its column, and what each tap sees, (tap, 3)."""
    rows, columns = array.period
    span = range(-RADIUS, RADIUS + 1)
    for row in range(rows):
        for column in range(columns):
            letters = [
                array.rows[(row + y) % rows][(column + x) % columns] for y in span for x in span
            ]
            yield row, column, np.array([array.responses[letter] for letter in letters])


def covariance(seen: Doubles, between: Doubles, chroma: float, noise: float) -> Doubles:
    """The covariance of a window's samples under a model, (tap, tap).

    Args:
        seen: what each tap sees of a colour, (tap, 3).
        between: the correlation of two taps' colours, (tap, tap).
        chroma: the variance of chroma, where that of luma is 1.
        noise: that of what the model leaves out.
    """
    return np.asarray(between * (seen @ _colours(chroma) @ seen.T) + noise * np.eye(len(seen)))


def _colours(chroma: float) -> Doubles:
    """The covariance of red, green and blue in one place."""
    gray = np.ones((3, 3))
    return np.asarray(gray + chroma * (np.eye(3) - gray / 3))


def best(seen: Doubles, between: Doubles, centre: Doubles, chroma: float, noise: float) -> Doubles:
    """The filters of one place, (tap, channel): least mean square error, flat colours exact, and a
    sample of red, green or blue kept.

    Args:
        seen: what each tap sees of a colour, (tap, 3).
        between: the correlation of the colours of two taps, (tap, tap).
        centre: that of the colours of a tap and the centre, (tap,).
        chroma: the variance of chroma, where that of luma is 1.
        noise: that of what the model leaves out.
    """
    samples = covariance(seen, between, chroma, noise)
    wanted = centre[:, None] * (seen @ _colours(chroma))
    tells_colours = np.linalg.matrix_rank(seen, 1e-3) == 3
    exact = np.eye(3) if tells_colours else np.ones((3, 1))  # flat colours, in columns
    lit = seen @ exact
    both = np.linalg.solve(samples, np.concatenate([wanted, lit], axis=1))
    free, flat = both[:, :3], both[:, 3:]
    lacking = exact.T - lit.T @ free
    made = np.asarray(free + flat @ np.linalg.solve(lit.T @ flat, lacking))
    middle = len(seen) // 2
    if 1 in seen[middle].tolist() and np.isclose(seen[middle].sum(), 1):  # a colour that is there
        made[:, seen[middle].argmax()] = np.arange(len(seen)) == middle
    return made


def linear_mmse(mosaic: Floats, array: FilterArray) -> Floats:
    """RGB, (height, width, 3), from a white-balanced mosaic, (height, width)."""
    return filtered(mosaic, array.period, filters(array))


def filtered(mosaic: Floats, period: tuple[int, int], made: Floats) -> Floats:
    """A mosaic through filters by place: (height, width, channel).

    Args:
        mosaic: (height, width).
        period: of its array, by which it goes on beyond its edges.
        made: the filters, (row, column, tap, channel), of a multiple of the period.
    """
    height, width = mosaic.shape
    wide = mosaic[np.ix_(beyond(height, period[0], RADIUS), beyond(width, period[1], RADIUS))]
    down, across = np.arange(height) % made.shape[0], np.arange(width) % made.shape[1]
    result = np.zeros((height, width, made.shape[-1]), np.float32)
    for tap in range(SIDE**2):
        y, x = divmod(tap, SIDE)
        weights = made[:, :, tap][np.ix_(down, across)]
        result += weights * wide[y : y + height, x : x + width, None]
    return result
