"""What noise is like: how large, at which intensity, how it hangs together in space, its tails.

Functions take planes: ``intensity`` (height, width) and ``noise`` (frame, height, width) in one
unit, and ``mask`` (height, width), True where a pixel counts. What a function cannot tell is NaN.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from clpipe.base.types import Floats

Doubles = NDArray[np.float64]
Mask = NDArray[np.bool_]
LAGS = 8
BINS = 24
FEWEST = 100  # samples, below which a bin's sigma is worth nothing
SIGMAS = (2, 3, 4, 5)
HISTOGRAM = np.linspace(-6.05, 6.05, 122)  # edges, so that 0 is in the middle of a bin


@dataclass(frozen=True)
class Curve:
    """Noise by intensity, a value a bin, ascending; bins with hardly a sample are left out."""

    bins: NDArray[np.int64]  # which of the edges' bins
    mean: Doubles  # intensity
    shift: Doubles  # mean of the noise
    sigma: Doubles  # of the noise, without the shift
    count: NDArray[np.int64]  # samples


@dataclass(frozen=True)
class Law:
    """The straight line variance = a*intensity + b, with standard errors."""

    a: float
    b: float
    a_error: float
    b_error: float


@dataclass(frozen=True)
class LineNoise:
    """The sigma of what rows (or columns) share, and what chance alone could show as one."""

    sigma: float
    limit: float


@dataclass(frozen=True)
class Tails:
    """The distribution of standardised noise: a Gaussian has skewness and excess kurtosis 0."""

    skewness: float
    excess_kurtosis: float
    beyond: tuple[float, ...]  # share of samples further from 0 than each of SIGMAS
    histogram: NDArray[np.int64]  # counts between HISTOGRAM's edges; the end bins take the rest


@dataclass(frozen=True)
class Channel:
    """The noise of one channel. Sizes are in the channel's unit, correlations without one."""

    name: str
    count: int  # samples, over all frames
    sigma: float
    curve: Curve
    law: Law | None
    rows: LineNoise
    columns: LineNoise
    autocorrelation: Doubles  # (17, 17), down and right from -8 to 8; [8, 8] is 1
    energy_left: float  # after averaging 2x2
    tails: Tails


def bin_edges(low: float, high: float, linear: bool) -> Doubles:
    """The edges of :data:`BINS` bins from the lowest intensity to the highest.

    Display values get bins of one width. Linear light gets bins whose edges are the squares of
    evenly spaced numbers, fine in the shadows, where a sensor's sigma (about the root of the
    intensity) changes most.

    >>> bin_edges(0, 576, linear=True)[:4].tolist()
    [0.0, 1.0, 4.0, 9.0]
    """
    place = np.linspace(0, 1, BINS + 1)
    return np.asarray(low + (high - low) * (place**2 if linear else place))


def bin_of(intensity: Floats, edges: Doubles) -> NDArray[np.int64]:
    """The bin, 0 to :data:`BINS` - 1, that each intensity is in; the ends take what is beyond.

    >>> bin_of(np.float32([-1, 0.2, 7]), np.linspace(0, 1, BINS + 1)).tolist()
    [0, 4, 23]
    """
    return np.clip(np.searchsorted(edges, intensity, "right") - 1, 0, len(edges) - 2)


def by_intensity(
    intensity: Floats, noise: Floats, mask: Mask, edges: Doubles, spread: float = 0.0
) -> tuple[Curve, Floats, Floats]:
    """Noise by intensity, and the noise without what intensity does to it.

    The mean of the noise at an intensity is a difference of tone between image and truth, not
    noise: it is taken out, in a straight line from bin to bin. Standardised noise is what is left
    over its sigma at that intensity, and so weighs dark and bright places alike.

    Args:
        intensity: (height, width).
        noise: (frame, height, width).
        mask: (height, width), the pixels that count; at least one.
        edges: of the intensity bins.
        spread: the variance of the intensity's own error, over that of the noise: 1 / n where it is
            the mean of n frames.

    Returns:
        The curve, the noise without the shift, and the same standardised to variance 1; both
        (frame, height, width), 0 where the mask is False.
    """
    values = intensity[mask].astype(np.float64)
    samples = noise[:, mask].astype(np.float64)
    index = bin_of(intensity[mask], edges)
    if np.bincount(index).max() * len(noise) < FEWEST:
        edges, index = edges[[0, -1]], np.zeros_like(index)
    bins = len(edges) - 1
    count = np.bincount(index, minlength=bins) * len(noise)
    used = np.flatnonzero(count >= min(FEWEST, count.max()))

    def mean_in_bins(weights: Doubles, per: int) -> Doubles:
        return np.bincount(index, weights, minlength=bins)[used] * per / count[used]

    mean = mean_in_bins(values, len(noise))
    shift = mean_in_bins(samples.sum(0), 1)
    samples -= np.interp(values, mean, shift)
    sigma = np.sqrt(mean_in_bins((samples**2).sum(0), 1))
    if spread and bins > 1:
        error = np.sqrt(spread * np.interp(edges[1:-1], mean, sigma**2))
        mean = mean + (_inflow(values, edges, error) * len(noise))[used] / count[used]
    curve = Curve(used, mean, shift, sigma, count[used])
    without = np.zeros(noise.shape, np.float32)
    without[:, mask] = samples
    here = np.sqrt(np.interp(values, mean, sigma**2))
    np.divide(samples, here, out=samples, where=here > 0)
    size = np.sqrt((samples**2).mean())
    standard = np.zeros(noise.shape, np.float32)
    standard[:, mask] = samples / size if size > 0 else 0
    return curve, without, standard


def _inflow(values: Doubles, edges: Doubles, error: Doubles) -> Doubles:
    """What values that have an error lack in each bin, summed up, of what they would be without.

    A bin that is chosen by a value with an error of sigma s holds, where values get rarer, more
    that came too far than not far enough: true values lie s^2 p'/p above those that were seen, p
    their density (Efron, "Tweedie's formula and selection bias", JASA 2011). Over a bin that sums
    up to s^2 p at its upper edge less that at the lower.
    """
    ordered = np.sort(values)
    near = np.searchsorted(ordered, edges[1:-1] + error) - np.searchsorted(
        ordered, edges[1:-1] - error
    )
    return np.diff(near * error / 2, prepend=0, append=0)


def pooled(curves: Sequence[Curve]) -> Curve:
    """The curve of several channels together, on the same edges."""
    bins, place = np.unique(np.concatenate([c.bins for c in curves]), return_inverse=True)
    count = np.concatenate([c.count for c in curves])
    total = np.bincount(place, count)

    def together(values: Sequence[Doubles]) -> Doubles:
        return np.bincount(place, np.concatenate(values) * count) / total

    variance = together([c.sigma**2 for c in curves])
    mean, shift = together([c.mean for c in curves]), together([c.shift for c in curves])
    return Curve(bins, mean, shift, np.sqrt(variance), total.astype(np.int64))


def fit_law(curve: Curve, independent: float = 1.0) -> Law | None:
    """Fit variance = a*intensity + b to a curve by weighted least squares.

    A bin of n independent samples tells its variance v with a standard error of v*sqrt(2/n)
    (normal noise); v in the weights is the line's own, found in a few rounds, because a bin's
    measured variance would give those that came out low too much weight. Where bins scatter more
    than that about the line, the standard errors are larger by as much.

    Args:
        curve: noise by intensity.
        independent: how many of the samples are independent, as a share.

    Returns:
        The law; None for fewer than two bins, or without noise.
    """
    if len(curve.mean) < 2 or not curve.sigma.any():
        return None
    variance, count = curve.sigma**2, curve.count * independent
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
    return Law(float(a), float(b), float(errors[0]), float(errors[1]))


def lag_sums(planes: NDArray[np.floating[Any]]) -> Doubles:
    """Sums of the products of all places a lag apart, lags of -8 to 8 down and right, (17, 17).

    By Fourier transform (Wiener-Khinchin), with a margin so that nothing meets the other side.
    Of a mask as 0 and 1 they are the numbers of pairs.
    """
    height, width = planes.shape[1:]
    shape = (height + LAGS, width + LAGS)
    lag = np.arange(-LAGS, LAGS + 1)
    total = np.zeros((lag.size, lag.size))
    for plane in planes:
        whole = np.fft.irfft2(np.abs(np.fft.rfft2(plane, shape)) ** 2, shape)
        total += whole[np.ix_(lag % shape[0], lag % shape[1])]
    return total


def pairs_of(mask: Mask) -> Doubles:
    """How many pairs of pixels that both count there are at each lag, (17, 17)."""
    return np.rint(lag_sums(mask[None].astype(np.float64)))


def autocorrelation(standard: Floats, pairs: Doubles) -> Doubles:
    """The autocorrelation of standardised noise for lags of -8 to 8 down and right, (17, 17).

    Args:
        standard: (frame, height, width), 0 where a pixel does not count.
        pairs: :func:`pairs_of` the mask.

    >>> plane = np.random.default_rng(0).normal(size=(1, 200, 200)).astype(np.float32)
    >>> table = autocorrelation(plane, pairs_of(np.ones((200, 200), bool)))
    >>> round(float(table[8, 8]), 6), bool(abs(table[8, 9]) < 0.03)
    (1.0, True)
    """
    products = lag_sums(standard)
    covariance = np.divide(products, pairs, out=np.full_like(products, np.nan), where=pairs > 0)
    variance = covariance[LAGS, LAGS]
    return covariance / variance if variance > 0 else np.full_like(covariance, np.nan)


def line_noise(noise: Floats, mask: Mask) -> LineNoise:
    """The sigma of the offset that all pixels of a row share (transpose for columns).

    The variance of row means holds that of the pixels as well. What rows share is instead the mean
    product of the noise at any two places of a row; pairs at most 8 apart are left out, so that
    noise which processing has smeared does not count as shared. The limit is the sigma that
    would be three standard errors of the variance.
    """

    def far_pairs(plane: NDArray[np.floating[Any]]) -> Doubles:
        total = plane.sum(-1, dtype=np.float64) ** 2 - (plane * plane).sum(-1, dtype=np.float64)
        for lag in range(1, min(LAGS, plane.shape[-1] - 1) + 1):
            near = (plane[..., lag:] * plane[..., :-lag]).sum(-1, dtype=np.float64)
            total -= 2 * near
        return total

    products = far_pairs(noise).ravel()
    pairs = np.tile(np.rint(far_pairs(mask.astype(np.float64))), len(noise))
    if pairs.sum() <= 0:
        return LineNoise(math.nan, math.nan)
    variance = products.sum() / pairs.sum()
    error = np.sqrt(((products - variance * pairs) ** 2).sum()) / pairs.sum()
    return LineNoise(math.sqrt(max(float(variance), 0.0)), math.sqrt(3 * float(error)))


def energy_left(standard: Floats, mask: Mask) -> float:
    """The share of the noise's energy that is left when 2x2 pixels are averaged.

    Independent noise keeps a quarter; what processing has correlated keeps more (Bielova et al.,
    CVPRW 2019). Blocks of which a pixel does not count are left out.
    """
    height, width = (size // 2 * 2 for size in mask.shape)
    blocks = standard[:, :height, :width].reshape(len(standard), height // 2, 2, width // 2, 2)
    whole = mask[:height, :width].reshape(height // 2, 2, width // 2, 2).all((1, 3))
    means = blocks.mean((2, 4), dtype=np.float64)[:, whole]
    energy = (blocks.astype(np.float64) ** 2).mean((2, 4))[:, whole].sum()
    return float((means**2).sum() / energy) if energy > 0 else math.nan


def tails(standard: Floats, mask: Mask) -> Tails:
    """The distribution of standardised noise: third and fourth moment, far samples, histogram."""
    values = standard[:, mask].astype(np.float64).ravel()
    ends = float(HISTOGRAM[0]), float(HISTOGRAM[-1])
    histogram = np.histogram(values.clip(*ends), len(HISTOGRAM) - 1, ends)[0]
    if not values.any():
        return Tails(math.nan, math.nan, (math.nan,) * len(SIGMAS), histogram)
    square, size = values * values, np.abs(values)
    beyond = tuple(np.count_nonzero(size > k) / values.size for k in SIGMAS)
    third, fourth = (square * values).mean(), (square * square).mean()
    return Tails(float(third), float(fourth) - 3, beyond, histogram)


def gaussian_beyond(sigmas: float) -> float:
    """The share of a Gaussian further from its mean than so many sigmas, both sides.

    >>> round(gaussian_beyond(2), 4)
    0.0455
    """
    return math.erfc(sigmas / math.sqrt(2))


def correlation(one: Floats, two: Floats, mask: Mask) -> float:
    """The correlation of two channels' standardised noise, at the same places."""
    first, second = one[:, mask].astype(np.float64), two[:, mask].astype(np.float64)
    size = math.sqrt(float((first**2).sum() * (second**2).sum()))
    return float((first * second).sum() / size) if size > 0 else math.nan


def channel(
    name: str,
    curve: Curve,
    noise: Floats,
    standard: Floats,
    mask: Mask,
    pairs: Doubles,
    lawful: bool,
    freedom: float = 1.0,
) -> Channel:
    """All statistics of one channel.

    Args:
        name: of the channel.
        curve: its noise by intensity.
        noise: (frame, height, width), the shift taken out.
        standard: the same, standardised.
        mask: (height, width), the pixels that count; at least one.
        pairs: :func:`pairs_of` the mask.
        lawful: whether variance = a*intensity + b is to be fitted.
        freedom: the share of samples that are free, below 1 where the truth is a mean of frames.
    """
    table = autocorrelation(standard, pairs)
    # Correlated samples tell less of a variance (Bartlett 1946): by the sum of squares.
    independent = freedom / float(np.nansum(table**2)) if np.isfinite(table).any() else freedom
    samples = noise[:, mask].astype(np.float64)
    rows, columns = line_noise(noise, mask), line_noise(noise.swapaxes(1, 2), mask.T)
    law = fit_law(curve, min(independent, freedom)) if lawful else None
    if law:
        # Each line has one offset: of its variance, lines tell no more than their number allows.
        frames, height, width = noise.shape
        in_rows, in_columns = rows.sigma**2 * (2 / (frames * height)) ** 0.5, 0.0
        if columns.sigma > columns.limit:
            in_columns = columns.sigma**2 * (2 / width) ** 0.5
        shared = [x for x in (in_rows, in_columns) if np.isfinite(x)]
        law = replace(law, b_error=float(np.hypot.reduce([law.b_error, *shared])))
    return Channel(
        name=name,
        count=samples.size,
        sigma=float(np.sqrt((samples**2).mean())),
        curve=curve,
        law=law,
        rows=rows,
        columns=columns,
        autocorrelation=table,
        energy_left=energy_left(standard, mask),
        tails=tails(standard, mask),
    )
