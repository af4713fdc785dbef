"""Demosaicing for any filter array by several image models, each weighted by its fit.

The models are those of :mod:`clpipe.reference.linear_mmse`, but longer in one of four directions,
with little colour or with much. Each model predicts a sample from its neighbours (leaving one out,
after Besag, "Statistical analysis of non-lattice data", 1975). Models with large errors around a
pixel get little weight there. Interpolation therefore follows edges, and colour is as smooth as in
the image.
"""

from functools import lru_cache

import numpy as np

from clpipe.base.types import Doubles, Floats
from clpipe.reference.filter_array import FilterArray
from clpipe.reference.image import mirrored
from clpipe.reference.linear_mmse import (
    SIDE,
    apply_filters,
    covariance,
    distances,
    mmse_filters,
    windows,
)

DIRECTIONS = 4  # the row, the falling diagonal, the column and the rising diagonal
# Parameters of the models. ALONG and ACROSS are the lengths in px within which the correlation
# falls to 1/e. SHAPE is between exponential (1) and Gaussian (2). CHROMAS are variances of chroma
# relative to luma. NOISE is the variance that a model does not describe. We chose the values for
# X-Trans, quad, RGBW and Bayer arrays. We used sixteen images of the Kodak set that docs/quality.md
# does not show, and every second image of McMaster's.
ALONG, ACROSS, SHAPE = 32.0, 11.0, 1.65
CHROMAS = (0.002, 0.3)
NOISE = 2.5e-5
MODELS = DIRECTIONS * len(CHROMAS)
REACH = 2  # px; errors are averaged over 5x5 pixels
ERROR_FLOOR = np.float32(1e-6)  # a negligible squared error: a thousandth of white


@lru_cache(maxsize=16)
def models(array: FilterArray) -> tuple[Floats, Floats]:
    """Return the filters of an array under each model: direction by direction, little colour first.

    Returns:
        The first array makes colours, (row, column, tap, model, channel), like
        :func:`~clpipe.reference.linear_mmse.filters`. The second gives the error of a sample's
        prediction from the others, (row, column, tap, model).
    """
    between, centre = distances()
    rows, columns = array.period
    colours = np.zeros((rows, columns, SIDE**2, MODELS, 3), np.float32)
    error_filters = np.zeros(colours.shape[:-1], np.float32)
    middle = SIDE**2 // 2
    for direction in range(DIRECTIONS):
        angle = direction * np.pi / DIRECTIONS
        taps, to_centre = _correlation(between, angle), _correlation(centre, angle)
        for row, column, responses in windows(array):
            for number, chroma in enumerate(CHROMAS, direction * len(CHROMAS)):
                model_filters = mmse_filters(responses, taps, to_centre, chroma, NOISE)
                colours[row, column, :, number] = model_filters
                # A row of a precision matrix computes the value minus its best estimate from the
                # others.
                precision_row = np.linalg.inv(covariance(responses, taps, chroma, NOISE))[middle]
                error_filters[row, column, :, number] = precision_row / precision_row[middle]
    return colours, error_filters


def _correlation(distances: Doubles, angle: float) -> Doubles:
    """Return the correlation of colours at these distances, (2, ...) in px, for one direction."""
    x, y = distances
    along = (x * np.cos(angle) + y * np.sin(angle)) / ALONG
    across = (y * np.cos(angle) - x * np.sin(angle)) / ACROSS
    return np.asarray(np.exp(-(np.hypot(along, across) ** SHAPE)))


def errors(mosaic: Floats, array: FilterArray) -> Floats:
    """Return the squared error of each model at each sample: (height, width, model)."""
    _, error_filters = models(array)
    return np.square(apply_filters(mosaic, array.period, error_filters))


def model_weights(squared: Floats) -> Floats:
    """Return the weight of each model, (height, width, model), from :func:`errors`; the sum is 1.

    >>> model_weights(np.float32([[[0.01, 0.02]]])).astype(float).round(3).tolist()
    [[[0.941, 0.059]]]
    """
    height, width = squared.shape[:2]
    wide = mirrored(squared, REACH)
    mean_errors = np.zeros_like(squared)
    for dy in range(2 * REACH + 1):
        for dx in range(2 * REACH + 1):
            mean_errors += wide[dy : dy + height, dx : dx + width]
    mean_errors = mean_errors * np.float32(1 / (2 * REACH + 1) ** 2) + ERROR_FLOOR
    weights = np.square(np.square(mean_errors.min(axis=-1, keepdims=True) / mean_errors))
    return weights / weights.sum(axis=-1, keepdims=True)


def directional_mmse(mosaic: Floats, array: FilterArray) -> Floats:
    """Return RGB, (height, width, 3), from a white-balanced mosaic, (height, width)."""
    colours, _ = models(array)
    weights = model_weights(errors(mosaic, array))
    result = np.zeros((*mosaic.shape, 3), np.float32)
    for number in range(MODELS):
        model_filters = np.ascontiguousarray(colours[:, :, :, number])
        result += weights[..., number, None] * apply_filters(mosaic, array.period, model_filters)
    return result
