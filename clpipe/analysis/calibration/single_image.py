"""Noise of a single raw image: Foi, Trimeche, Katkovnik, Egiazarian, "Practical
Poissonian-Gaussian noise modeling and fitting for single-image raw-data", IEEE TIP 17(10), 2008.

Wavelet details of smooth places contain only noise. Places of similar smoothed value form a level
set, which has a mean and a standard deviation. The line variance = a*y + b is the most likely one
for all these pairs. Clipped samples are modelled, not excluded (sec. III).

The method differs from the paper in three ways:

- The deviation of a level set comes from places whose local variance the previous line explains.
  The median of all details would be far too large if half of a picture is textured.
- The integral of the likelihood over the unknown y of a level set is computed to first order. The
  mean of a set is known far better than its deviation.
- The optimum is searched over the variances at both ends of the light, so b may be negative.
"""

import contextlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from clpipe.analysis.calibration.line_fit import Estimate, Line
from clpipe.analysis.calibration.repeats import Sensor
from clpipe.base.types import Floats

# Daubechies' wavelet and scaling function with three vanishing moments (sec. II-A). The norm of the
# wavelet is 1, and the sum of the scaling function is 1.
WAVELET = np.array([0.035226, 0.085441, -0.135011, -0.459878, 0.806892, -0.332671])
SCALING = np.array([0.332671, 0.806892, 0.459878, -0.135011, -0.085441, 0.035226]) / np.sqrt(2)
# EDGE is from the paper. We chose the others; tests/test_calibrate.py checks the accuracy.
LEVELS = 150  # largest number of level sets of a colour
MIN_SET_SIZE = 400  # smallest number of places in a level set
MIN_EXPLAINED = 40  # smallest number of places in a level set that the line explains
WINDOW = 7  # px; the window for smoothing and for local variances
EDGE = 1.0  # tau, in standard deviations of the details (sec. II-B1)
# Relative to the line's variance; this is two standard deviations of a local variance above 1.
EXPLAINED = 1.4
ROUNDS = 8  # rounds; each selects places with the line of the previous round
GRID = 2000  # points at which the model of clipping is tabulated
Values = NDArray[np.float64]


@dataclass(frozen=True)
class SmoothSamples:
    """Smooth places of one colour: smoothed signal, signal and local variance of each."""

    smooth: Values
    signal: Values
    variance: Values

    def sets(self) -> list[NDArray[np.intp]]:
        """Return the level sets as indices: places by smoothed signal, in sets of equal size."""
        order = np.argsort(self.smooth, kind="stable")
        return np.array_split(order, min(LEVELS, len(order) // MIN_SET_SIZE) or 1)


@dataclass(frozen=True)
class LevelSets:
    """Level sets: the mean of the clipped signal, its standard deviation, the number of places."""

    mean: Values
    deviation: Values
    count: Values


def joined(parts: Sequence[LevelSets]) -> LevelSets:
    """Return several collections of level sets as one."""
    columns = ([getattr(p, name) for p in parts] for name in ("mean", "deviation", "count"))
    return LevelSets(*(np.concatenate(column) for column in columns))


def smooth_samples(plane: Floats) -> SmoothSamples:
    """Return the smooth places in the plane of one colour, (height, width) (sec. II-A, II-B).

    A place is smooth if the Laplacian of the smoothed image plus the magnitude of the Laplacian's
    gradient is less than the local standard deviation of the details. Values are signal.
    """
    from scipy.ndimage import convolve1d, laplace, sobel, uniform_filter

    def decimated(kernel: Values) -> Values:
        rows = convolve1d(plane.astype(np.float64), kernel, axis=0, mode="mirror")[::2]
        return convolve1d(rows, kernel, axis=1, mode="mirror")[:, ::2]

    detail, approximation = decimated(WAVELET), decimated(SCALING)
    smooth = uniform_filter(approximation, WINDOW, mode="mirror")
    local = np.sqrt(np.pi / 2) * uniform_filter(np.abs(detail), WINDOW, mode="mirror")
    bend = laplace(smooth, mode="mirror")
    slope = np.hypot(sobel(bend, 0, mode="mirror"), sobel(bend, 1, mode="mirror")) / 8
    flat = slope + np.abs(bend) < EDGE * local
    # The filter's running sum may be negative.
    variance = np.maximum(uniform_filter(detail * detail, WINDOW, mode="mirror"), 0)
    return SmoothSamples(smooth[flat], approximation[flat], variance[flat])


def explained_line(
    parts: Sequence[SmoothSamples], low: float, dark: Sequence[LevelSets] = ()
) -> tuple[float, float, LevelSets, Values]:
    """Return the line of the places that it explains, and their level sets.

    The first line goes through each set's 5 % quantile of local variances, scaled to the variance
    of a chi-square distribution with that quantile. In each further round, only places below 1.4
    times the line are used. Their mean is divided by that of a chi-square distribution cut at 1.4.

    Args:
        parts: the smooth places of each colour.
        low: the signal at 0 DN, where it clips.
        dark: further level sets, from dark frames.

    Returns:
        a and b in signal units, the level sets, and the standard errors of a and b.

    Raises:
        ValueError: there are too few sets, or all have the same light.
    """
    from scipy.stats import chi2

    freedom = WINDOW**2
    cut = chi2.cdf(EXPLAINED * freedom, freedom + 2) / chi2.cdf(EXPLAINED * freedom, freedom)
    lowest = chi2.ppf(0.05, freedom) / freedom
    places = [(part, chosen) for part in parts for chosen in part.sets()]
    moments = [
        (part.signal[i].mean(), np.quantile(part.variance[i], 0.05) / lowest, len(i))
        for part, i in places
    ]
    for _ in range(ROUNDS):
        mean, variance, count = np.array(moments, np.float64).reshape(-1, 3).T
        sets = joined([LevelSets(mean, np.sqrt(variance), count), *dark])
        a, b, errors = most_likely_line(sets, low)
        moments = []
        for part, i in places:
            explained = i[part.variance[i] < EXPLAINED * np.maximum(a * part.smooth[i] + b, 1e-12)]
            # A higher minimum would drop sets that lost places by chance, which biases the line.
            if len(explained) >= MIN_EXPLAINED:
                mean_variance = part.variance[explained].mean() / cut
                moments.append((part.signal[explained].mean(), mean_variance, len(explained)))
    return a, b, sets, errors


def clipped_normal(u: Values) -> tuple[Values, Values]:
    """Return mean and deviation of a normal of mean u and deviation 1, clipped to values above 0.

    The mean is `E_m(u) = Phi(u) u + phi(u)`. The variance is `S_m(u)^2 = Phi(u) + phi(u) u -
    phi(u)^2 + Phi(u) u (u - Phi(u) u - 2 phi(u))` (sec. III-B).
    """
    from scipy.special import ndtr

    below, density = ndtr(u), np.exp(-u * u / 2) / np.sqrt(2 * np.pi)
    mean = below * u + density
    square = below + density * u - density**2 + below * u * (u - below * u - 2 * density)
    return mean, np.sqrt(np.maximum(square, 1e-12))


def clipped_moments(y: Values, deviation: Values, low: float) -> tuple[Values, Values]:
    """Return mean and deviation of y plus Gaussian noise, clipped to low..1 (sec. III-B).

    The two ends are combined as if they were far apart.

    >>> mean, deviation = clipped_moments(np.array([0.0, 0.5]), np.array([0.1, 0.1]), 0.0)
    >>> mean.round(4).tolist(), deviation.round(4).tolist()
    ([0.0399, 0.5], [0.0584, 0.1])
    """
    from_low, low_deviation = clipped_normal((y - low) / deviation)
    from_high, high_deviation = clipped_normal((1 - y) / deviation)
    mean = low + deviation * from_low + 1 - deviation * from_high - y
    return mean, deviation * low_deviation * high_deviation


def most_likely_line(sets: LevelSets, low: float) -> tuple[float, float, Values]:
    """Return the most likely line of level sets (sec. II-C and III-C), in signal units.

    Each set's deviation is compared with that of the clipped model at the set's mean. Its relative
    variance is 1.35 / (n + 1.5) for n places. Its distribution is half a Gaussian and half a
    Cauchy, which tolerates sets with texture.

    Args:
        sets: level sets of signal, where 1 is the white level.
        low: the signal at 0 DN, where it clips.

    Returns:
        a, b, and their standard errors (from the curvature of the likelihood).

    Raises:
        ValueError: there are too few sets, or all have the same light.
    """
    from scipy.optimize import minimize

    mean, deviation, count = sets.mean, sets.deviation, sets.count
    # Sets in which nearly every sample is clipped cannot be measured.
    used = (mean < 0.995) & (mean > low + 0.005 * (1 - low)) & (deviation > 0)
    mean, deviation, count = mean[used], deviation[used], count[used]
    if len(mean) < 8 or np.ptp(mean) < 0.02:
        raise ValueError("the image has too few smooth areas of different brightness")
    dark, bright = float(mean.min()), float(mean.max())
    grid = np.linspace(min(dark, 0) - 0.05, 1.3, GRID)
    scatter = 1.35 / (count + 1.5)

    def line(ends: Values) -> Values:
        first, last = np.exp(ends)
        a = (last - first) / (bright - dark)
        return np.array([a, first - a * dark])

    def cost(ends: Values) -> float:
        a, b = line(ends)
        sigma = np.sqrt(np.maximum(a * grid + b, 1e-12))
        clipped_mean, clipped_sigma = clipped_moments(grid, sigma, low)
        rising = np.maximum.accumulate(clipped_mean)
        model = np.interp(mean, rising, clipped_sigma)
        slope = np.gradient(clipped_sigma) / (np.gradient(clipped_mean) + 1e-12)
        steep = np.interp(mean, rising, slope)
        width = model * np.sqrt(scatter + np.clip(steep, -9, 9) ** 2 / (4 * count))
        t = (deviation - model) / width
        gauss = np.exp(-0.5 * np.minimum(np.abs(t), 38) ** 2) / np.sqrt(2 * np.pi)
        cauchy = 1 / (np.pi * (1 + t * t))
        return float(-np.log((0.5 * gauss + 0.5 * cauchy) / width).sum())

    order = np.argsort(mean)
    ends = [np.median(deviation[order[part]] ** 2) for part in (slice(0, 5), slice(-5, None))]
    start = np.log(np.maximum(ends, 1e-12))
    options = {"xatol": 1e-4, "fatol": 1e-4, "maxiter": 2000}
    best = minimize(cost, start, method="Nelder-Mead", options=options).x
    a, b = line(best)
    return float(a), float(b), _errors(cost, best, line)


def _errors(
    cost: Callable[[Values], float], at: Values, line: Callable[[Values], Values]
) -> Values:
    """Return the standard errors of a and b, from the curvature of the likelihood's optimum."""
    step = 0.01
    unit = np.eye(2) * step
    curvature = np.empty((2, 2))
    for i in range(2):
        for j in range(2):
            corners = cost(at + unit[i] + unit[j]) - cost(at + unit[i] - unit[j])
            corners += cost(at - unit[i] - unit[j]) - cost(at - unit[i] + unit[j])
            curvature[i, j] = corners / (4 * step**2)
    slopes = np.array([line(at + unit[i]) - line(at - unit[i]) for i in range(2)]).T / (2 * step)
    covariance = slopes @ np.linalg.pinv(curvature) @ slopes.T
    return np.sqrt(np.maximum(np.diag(covariance), 0))


def single_image(
    light: Floats, sensor: Sensor, dark: LevelSets | None = None
) -> tuple[dict[str, Line], Line, LevelSets]:
    """Return the lines of a mosaic's channels, the line of all channels, and its level sets.

    Diagonal wavelet details are used, which exclude row and column noise. A channel with too few
    smooth places has no line.

    Args:
        light: (height, width) above black, DN.
        sensor: its pattern and levels.
        dark: a level set of dark frames, signal units, or None.

    Raises:
        ValueError: there are too few smooth places, or all have the same light.
    """
    unit = sensor.unit
    low = -sensor.black_level / unit
    dark_sets = [dark] if dark else []
    places = {
        name: [smooth_samples(light[site] / unit) for site in own]
        for name, own in sensor.channels.items()
    }

    def line(parts: Sequence[SmoothSamples]) -> tuple[Line, LevelSets]:
        a, b, sets, errors = explained_line(parts, low, dark_sets)
        gain, floor = Estimate(a, float(errors[0])), Estimate(b, float(errors[1]))
        pixels = int(sets.count.sum()) * 4  # there is one place for every 2x2 pixels
        return Line(gain.scaled(unit), floor.scaled(unit**2), pixels), sets

    whole, sets = line([part for parts in places.values() for part in parts])
    lines = {}
    for name, parts in places.items():
        with contextlib.suppress(ValueError):
            lines[name] = line(parts)[0]
    return lines, whole, sets
