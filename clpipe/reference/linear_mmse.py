"""Linear demosaicing for any filter array: the best linear estimate under a model of images.

After Trussell and Hartley, "Primary demosaicing using Kodak cameras" (ICIP 2002), and Portilla,
Otaduy and Dorronsoro, "Low-complexity linear demosaicing using joint spatial-chromatic image
statistics" (ICIP 2005): of each place of the period, the filters that leave the least mean square
error. The statistics are a model's here, so that they are there for any array.
"""

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
    rows, columns = array.period
    span = range(-RADIUS, RADIUS + 1)
    taps = np.array([(y, x) for y in span for x in span])
    between = _covariance(np.linalg.norm(taps[:, None] - taps, axis=-1))
    centre = _covariance(np.linalg.norm(taps, axis=-1))
    made = np.zeros((rows, columns, len(taps), 3), np.float32)
    for row in range(rows):
        for column in range(columns):
            letters = [
                array.rows[(row + y) % rows][(column + x) % columns] for y, x in taps.tolist()
            ]
            seen = np.array([array.responses[letter] for letter in letters])  # (tap, rgb)
            own = _best(seen, between, centre)
            middle = seen[len(taps) // 2]
            if 1 in middle.tolist():  # a colour that is there
                own[:, middle.argmax()] = np.arange(len(taps)) == len(taps) // 2
            made[row, column] = own
    return made


def _covariance(distance: Doubles) -> Doubles:
    """The covariance of colours at a distance: its shape, and 3x3."""
    gray = np.ones((3, 3))
    colours = gray + CHROMA * (np.eye(3) - gray / 3)
    return np.asarray(NEIGHBOURS**distance)[..., None, None] * colours


def _best(seen: Doubles, between: Doubles, centre: Doubles) -> Doubles:
    """The filters of one place, (tap, channel): least mean square error, flat colours exact.

    Args:
        seen: what each tap sees of a colour, (tap, 3).
        between: the covariance of the colours of two taps, (tap, tap, 3, 3).
        centre: that of the colours of a tap and the centre, (tap, 3, 3).
    """
    samples = np.einsum("ia,ijab,jb->ij", seen, between, seen) + NOISE * np.eye(len(seen))
    wanted = np.einsum("iab,ib->ia", centre, seen)
    tells_colours = np.linalg.matrix_rank(seen, 1e-3) == 3
    exact = np.eye(3) if tells_colours else np.ones((3, 1))  # flat colours, in columns
    lit = seen @ exact
    both = np.linalg.solve(samples, np.concatenate([wanted, lit], axis=1))
    free, flat = both[:, :3], both[:, 3:]
    lacking = exact.T - lit.T @ free
    return np.asarray(free + flat @ np.linalg.solve(lit.T @ flat, lacking))


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
