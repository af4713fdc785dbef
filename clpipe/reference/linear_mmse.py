"""Linear demosaicing for any filter array: the best linear estimate under an image model.

After Trussell and Hartley, "Primary demosaicing using Kodak cameras" (ICIP 2002), and Portilla,
Otaduy and Dorronsoro, "Low-complexity linear demosaicing using joint spatial-chromatic image
statistics" (ICIP 2005). For each position of the period, the filters have the least mean square
error. The statistics come from a model, so that they exist for any array.
"""

from collections.abc import Iterator
from functools import lru_cache

import numpy as np

from clpipe.base.types import Doubles, Floats
from clpipe.reference.filter_array import FilterArray, periodic_indices

RADIUS = 3  # px; windows are 7x7
SIDE = 2 * RADIUS + 1
# The model. Luma is the same in red, green and blue and has variance 1. Chroma sums to zero, and
# each colour's chroma has the variance CHROMA. Both are isotropic. The correlation is CORRELATION
# to the power of the distance in px. We chose the values on eight images of the Kodak set, for
# RGGB, quad and X-Trans (docs/quality.md).
CORRELATION = 0.95
CHROMA = 0.05
NOISE = 1e-4  # variance that the model does not describe


@lru_cache(maxsize=16)
def filters(array: FilterArray) -> Floats:
    """Return the filters of an array: (row, column, tap, channel) float32; taps by rows of 7x7.

    The filters keep samples of red, green or blue, and do not change a flat colour. For an array
    that cannot distinguish all colours, flat grey does not change.
    """
    between, centre = (CORRELATION ** np.hypot(*offsets) for offsets in distances())
    rows, columns = array.period
    result = np.zeros((rows, columns, SIDE**2, 3), np.float32)
    for row, column, responses in windows(array):
        result[row, column] = mmse_filters(responses, between, centre, CHROMA, NOISE)
    return result


def distances() -> tuple[Doubles, Doubles]:
    """Return the distances between two taps of a window, and of a tap and the centre, in x and y.

    Both in px: (2, tap, tap) and (2, tap).
    """
    span = np.arange(-RADIUS, RADIUS + 1.0)
    x, y = np.tile(span, SIDE), np.repeat(span, SIDE)
    positions = np.stack([x, y])
    return positions[:, :, None] - positions[:, None], positions


def windows(array: FilterArray) -> Iterator[tuple[int, int, Doubles]]:
    """Yield each position of an array's period: its row, column, and taps' responses, (tap, 3)."""
    rows, columns = array.period
    span = range(-RADIUS, RADIUS + 1)
    for row in range(rows):
        for column in range(columns):
            letters = [
                array.rows[(row + y) % rows][(column + x) % columns] for y in span for x in span
            ]
            yield row, column, np.array([array.responses[letter] for letter in letters])


def covariance(
    responses: Doubles, tap_correlation: Doubles, chroma: float, noise: float
) -> Doubles:
    """Return the covariance of a window's samples under a model, (tap, tap).

    Args:
        responses: the response of each tap to a colour, (tap, 3).
        tap_correlation: the correlation of two taps' colours, (tap, tap).
        chroma: the variance of chroma, relative to the variance of luma.
        noise: the variance of the rest that the model does not describe.
    """
    return np.asarray(
        tap_correlation * (responses @ _colours(chroma) @ responses.T)
        + noise * np.eye(len(responses))
    )


def _colours(chroma: float) -> Doubles:
    """Return the covariance of red, green and blue at one position."""
    gray = np.ones((3, 3))
    return np.asarray(gray + chroma * (np.eye(3) - gray / 3))


def mmse_filters(
    responses: Doubles,
    tap_correlation: Doubles,
    centre_correlation: Doubles,
    chroma: float,
    noise: float,
) -> Doubles:
    """Return the filters of one position, (tap, channel), with the least mean square error.

    Flat colours are exact, and a sample of red, green or blue is kept.

    Args:
        responses: the response of each tap to a colour, (tap, 3).
        tap_correlation: the correlation of the colours of two taps, (tap, tap).
        centre_correlation: the correlation of the colours of a tap and the centre, (tap,).
        chroma: the variance of chroma, relative to the variance of luma.
        noise: the variance of the rest that the model does not describe.
    """
    samples = covariance(responses, tap_correlation, chroma, noise)
    cross_covariance = centre_correlation[:, None] * (responses @ _colours(chroma))
    has_colours = np.linalg.matrix_rank(responses, 1e-3) == 3
    # Columns are the flat colours that must be exact.
    exact = np.eye(3) if has_colours else np.ones((3, 1))
    flat_samples = responses @ exact
    solution = np.linalg.solve(samples, np.concatenate([cross_covariance, flat_samples], axis=1))
    free, flat = solution[:, :3], solution[:, 3:]
    residual = exact.T - flat_samples.T @ free
    result = np.asarray(free + flat @ np.linalg.solve(flat_samples.T @ flat, residual))
    middle = len(responses) // 2
    # A colour that was sampled keeps its sample.
    if 1 in responses[middle].tolist() and np.isclose(responses[middle].sum(), 1):
        result[:, responses[middle].argmax()] = np.arange(len(responses)) == middle
    return result


def linear_mmse(mosaic: Floats, array: FilterArray) -> Floats:
    """Return RGB, (height, width, 3), from a white-balanced mosaic, (height, width)."""
    return apply_filters(mosaic, array.period, filters(array))


def apply_filters(mosaic: Floats, period: tuple[int, int], filters_: Floats) -> Floats:
    """Apply filters by position to a mosaic: (height, width, channel).

    Args:
        mosaic: (height, width).
        period: period of its array, which continues it outside its edges.
        filters_: the filters, (row, column, tap, channel), for a multiple of the period.
    """
    height, width = mosaic.shape
    padded = mosaic[
        np.ix_(
            periodic_indices(height, period[0], RADIUS), periodic_indices(width, period[1], RADIUS)
        )
    ]
    down, across = np.arange(height) % filters_.shape[0], np.arange(width) % filters_.shape[1]
    result = np.zeros((height, width, filters_.shape[-1]), np.float32)
    for tap in range(SIDE**2):
        y, x = divmod(tap, SIDE)
        weights = filters_[:, :, tap][np.ix_(down, across)]
        result += weights * padded[y : y + height, x : x + width, None]
    return result
