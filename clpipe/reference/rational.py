"""A rational function of r^2 that approximates a radial model with odd powers of r."""

import numpy as np

from clpipe.base.types import Array

DEGREE = 3  # degree in r^2 of numerator and denominator, like OpenCV's k1 to k6
ITERATIONS = 40


def fit_even(r: Array, r_d: Array) -> tuple[list[float], list[float], float] | None:
    """Return N and M of r_d = r N(r^2) / M(r^2), from the lowest power up, M(0) = 1.

    Least squares, linearised with the denominator of the previous step (Sanathanan and Koerner
    1963). Weights grow where the error is large (Lawson 1961), so that the largest error becomes
    small instead of the mean.

    Args:
        r: radii from 0 up, float64.
        r_d: the radius that each becomes.

    Returns:
        N, M and the largest error; None if no denominator without zeros is found.

    >>> r = np.linspace(0, 1, 200)
    >>> above, below, error = fit_even(r, r * (1.02 - 0.03 * r + 0.01 * r**2))
    >>> len(above), len(below), error < 2e-5
    (4, 4, True)
    """
    longest = r[-1]
    powers = (r / longest)[:, None] ** (2 * np.arange(DEGREE + 1))
    columns = np.concatenate([r[:, None] * powers, -r_d[:, None] * powers[:, 1:]], 1)
    below, weights = np.ones_like(r), np.ones_like(r)
    best, least = None, np.inf
    for _ in range(ITERATIONS):
        w = np.sqrt(weights) / np.abs(below)
        found = np.linalg.lstsq(columns * w[:, None], r_d * w, rcond=None)[0]
        above = powers @ found[: DEGREE + 1]
        below = powers @ np.concatenate([[1.0], found[DEGREE + 1 :]])
        error = np.abs(r * above / below - r_d)
        if below.min() > 0 and error.max() < least:
            best, least = found, float(error.max())
        weights = weights * (error / (error.max() or 1.0)) + 1e-12
    if best is None:
        return None
    grown = longest ** (-2.0 * np.arange(DEGREE + 1))
    n, m = best[: DEGREE + 1] * grown, np.concatenate([[1.0], best[DEGREE + 1 :]]) * grown
    return n.tolist(), m.tolist(), least
