"""Noise by intensity: its size in intensity bins, and the line variance = a*intensity + b.

Functions take planes: ``intensity`` (height, width) and ``noise`` (frame, height, width) in one
unit, and ``mask`` (height, width), which is True for valid pixels.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from clpipe.base.types import Doubles, Floats, Mask

NOT_IN_JSON = {"json": False}  # metadata of fields that reports omit
BINS = 24
MIN_SAMPLES = 100  # samples in a bin, for which the standard error of sigma is 7 %

# Statistics of a bin are distorted if more than this share of its samples are clipped. We chose the
# value; tests/test_statistics.py shows its effect.
CLIPPED = 1e-3


@dataclass(frozen=True)
class NoiseCurve:
    """Noise by intensity: one value for each bin with enough samples, in ascending order."""

    mean: Doubles  # mean intensity
    sigma: Doubles  # the standard deviation of the noise about the shift
    shift: Doubles  # the mean of the noise
    samples: NDArray[np.int64]  # their number
    bins: NDArray[np.int64] = field(metadata=NOT_IN_JSON)  # the numbers of the bins


@dataclass(frozen=True)
class VarianceLaw:
    """The line variance = a*intensity + b, with the standard errors of a and b."""

    a: float
    b: float
    a_error: float
    b_error: float


def bin_edges(low: float, high: float, linear: bool) -> Doubles:
    """Return the edges of :data:`BINS` bins from the lowest intensity to the highest.

    Display values get bins of equal width. For ``linear`` light, the edges are squares of evenly
    spaced numbers. Bins are then fine in the shadows, where a sensor's sigma, which is about the
    root of the intensity, changes most.

    >>> bin_edges(0, 576, linear=True)[:4].tolist()
    [0.0, 1.0, 4.0, 9.0]
    """
    steps = np.linspace(0, 1, BINS + 1)
    return np.asarray(low + (high - low) * (steps**2 if linear else steps))


def bin_of(intensity: Floats, edges: Doubles) -> NDArray[np.int64]:
    """Return the number of each intensity's bin. Values outside belong to the first or last bin.

    >>> bin_of(np.float32([-1, 0.2, 7]), np.linspace(0, 1, BINS + 1)).tolist()
    [0, 4, 23]
    """
    return np.clip(np.searchsorted(edges, intensity, "right") - 1, 0, len(edges) - 2)


def select_unclipped(intensity: Floats, clipped: Mask, edges: Doubles, start: Mask) -> Mask:
    """Return the pixels of ``start`` at intensities where clipping does not distort the noise.

    Excluding only clipped samples would leave a one-sided distribution. Therefore an intensity bin
    is excluded if more than :data:`CLIPPED` of its samples are clipped. In other bins, each pixel
    that is clipped in any frame is excluded.

    Args:
        intensity: (height, width).
        clipped: True for clipped samples, (frame, height, width).
        edges: edges of the intensity bins.
        start: the pixels to select from, (height, width).
    """
    index = bin_of(intensity, edges)
    size = len(edges) - 1
    count = np.bincount(index[start], minlength=size)
    lost = np.bincount(index[start], clipped.mean(0)[start], minlength=size)
    whole = lost <= CLIPPED * count
    return start & whole[index] & ~clipped.any(0)


def noise_by_intensity(
    intensity: Floats, noise: Floats, mask: Mask, edges: Doubles, spread: float = 0.0
) -> tuple[NoiseCurve, Floats, Floats]:
    """Return noise by intensity, and the noise with its dependence on intensity removed.

    The mean of the noise at an intensity is a difference of tone between image and truth, so it is
    subtracted, with linear interpolation between bins. Standardised noise is the rest divided by
    its sigma at that intensity, which gives dark and bright places equal weight.

    Args:
        intensity: (height, width).
        noise: (frame, height, width).
        mask: the valid pixels, (height, width); at least one.
        edges: edges of the intensity bins.
        spread: the variance of the intensity's own error relative to that of the noise: 1 / n if
            the intensity is the mean of n frames.

    Returns:
        The curve, the noise without the shift, and the standardised noise of variance 1; both
        (frame, height, width), 0 where the mask is False.
    """
    values = intensity[mask].astype(np.float64)
    samples = noise[:, mask].astype(np.float64)
    index = bin_of(intensity[mask], edges)
    if np.bincount(index).max() * len(noise) < MIN_SAMPLES:
        edges, index = edges[[0, -1]], np.zeros_like(index)
    bins = len(edges) - 1
    count = np.bincount(index, minlength=bins) * len(noise)
    used = np.flatnonzero(count >= min(MIN_SAMPLES, count.max()))

    def mean_in_bins(weights: Doubles, per: int) -> Doubles:
        return np.bincount(index, weights, minlength=bins)[used] * per / count[used]

    mean = mean_in_bins(values, len(noise))
    shift = mean_in_bins(samples.sum(0), 1)
    samples -= np.interp(values, mean, shift)
    sigma = np.sqrt(mean_in_bins((samples**2).sum(0), 1))
    if spread and bins > 1:
        error = np.sqrt(spread * np.interp(edges[1:-1], mean, sigma**2))
        mean = mean + (_selection_bias(values, edges, error) * len(noise))[used] / count[used]
    curve = NoiseCurve(mean, sigma, shift, count[used], used)
    without = np.zeros(noise.shape, np.float32)
    without[:, mask] = samples
    here = np.sqrt(np.interp(values, mean, sigma**2))
    np.divide(samples, here, out=samples, where=here > 0)
    size = np.sqrt((samples**2).mean())
    standard = np.zeros(noise.shape, np.float32)
    standard[:, mask] = samples / size if size > 0 else 0
    return curve, without, standard


def _selection_bias(values: Doubles, edges: Doubles, error: Doubles) -> Doubles:
    """Return, for each bin, the sum of true values minus the sum of observed values.

    Values with an error of sigma s are sorted into bins by their observed value. On average, the
    true value is higher by s^2 p'/p, where p is the density of observed values (Efron, "Tweedie's
    formula and selection bias", JASA 2011). The sum over a bin is the difference of s^2 p between
    its upper and its lower edge. The density is estimated from values within one s of the edge.

    Args:
        values: the observed valid values.
        edges: edges of the bins.
        error: s at each inner edge.
    """
    ordered = np.sort(values)
    near = np.searchsorted(ordered, edges[1:-1] + error) - np.searchsorted(
        ordered, edges[1:-1] - error
    )
    return np.diff(near * error / 2, prepend=0, append=0)


def pool_curves(curves: Sequence[NoiseCurve]) -> NoiseCurve:
    """Return the curve of several channels together; all curves have the same edges."""
    bins, place = np.unique(np.concatenate([c.bins for c in curves]), return_inverse=True)
    count = np.concatenate([c.samples for c in curves])
    total = np.bincount(place, count)

    def weighted_mean(values: Sequence[Doubles]) -> Doubles:
        return np.bincount(place, np.concatenate(values) * count) / total

    variance = weighted_mean([c.sigma**2 for c in curves])
    mean = weighted_mean([c.mean for c in curves])
    shift = weighted_mean([c.shift for c in curves])
    return NoiseCurve(mean, np.sqrt(variance), shift, total.astype(np.int64), bins)


def fit_variance(curve: NoiseCurve, independent: float = 1.0) -> VarianceLaw | None:
    """Fit variance = a*intensity + b to a curve by weighted least squares.

    The variance v of a bin of n independent normal samples has the standard error v*sqrt(2/n). In
    ten rounds, the weights take v from the fitted line, because measured values that are low by
    chance would get too much weight. If bins scatter more than expected, the standard errors grow
    in proportion.

    Args:
        curve: noise by intensity.
        independent: the share of independent samples.

    Returns:
        The law; None if there are fewer than two bins, or no noise.
    """
    if len(curve.mean) < 2 or not curve.sigma.any():
        return None
    variance, count = curve.sigma**2, curve.samples * independent
    terms = np.stack([curve.mean, np.ones_like(curve.mean)], axis=1)
    expected = np.full_like(variance, np.average(variance, weights=count))
    for _ in range(10):
        weights = count / (2 * expected**2)
        inverse = np.linalg.inv((terms.T * weights) @ terms)
        a, b = inverse @ (terms.T * weights) @ variance
        expected = np.maximum(a * curve.mean + b, variance.max() * 1e-6)
    scatter = ((variance - terms @ (a, b)) ** 2 * weights).sum()
    excess = max(1.0, scatter / (len(variance) - 2)) if len(variance) > 2 else 1.0
    errors = np.sqrt(np.diag(inverse) * excess)
    return VarianceLaw(float(a), float(b), float(errors[0]), float(errors[1]))
