"""Gaussian models of a sensor: the effect of rounding on dark noise, and the noise maximum."""

import numpy as np

from clpipe.analysis.calibration.single_image import clipped_normal
from clpipe.base.types import Doubles

COARSE = 1.0  # DN; if noise is larger, rounding only adds 1/12 DN^2
NODES, WEIGHTS = np.polynomial.hermite_e.hermegauss(21)
NODE_WEIGHTS = WEIGHTS / WEIGHTS.sum()
FINE = np.linspace(-4, 4, 161)  # standard deviations; the points at which rounding is sampled
FINE_WEIGHTS = np.exp(-FINE * FINE / 2) / np.exp(-FINE * FINE / 2).sum()
SEARCH_RANGE = np.linspace(0.6, 1.1, 2001)  # light to try, relative to the light that fills a pixel
ROUNDS = 20  # rounds of the search for a full well


def before_rounding(mean: float, temporal: float, spatial: float) -> tuple[float, float, float]:
    """Return mean, temporal deviation and spatial deviation in DN, before frames were rounded.

    Above a temporal deviation of 1 DN, rounding adds 1/12 DN^2 to its variance. Below that, it
    shifts means, and reduces or increases both variances. In this case, the function finds the
    Gaussian sensor whose rounded frames have the three values.

    Args:
        mean: the mean of the rounded frames, DN.
        temporal: the variance of a rounded pixel over time, DN^2.
        spatial: the variance of the means of rounded pixels, DN^2.

    >>> [round(each, 3) for each in before_rounding(100.2, 4 + 1 / 12, 0.04)]
    [100.2, 2.0, 0.2]
    >>> [round(each, 3) for each in before_rounding(*rounded(2.8, 0.3, 0.2))]
    [2.8, 0.3, 0.2]
    """
    from scipy.optimize import least_squares

    plain = mean, max(temporal - 1 / 12, 0) ** 0.5, max(spatial, 0) ** 0.5
    if plain[1] > COARSE:
        return plain
    wanted = np.array([mean, max(temporal, 0) ** 0.5, max(spatial, 0) ** 0.5])

    def misfit(sensor: Doubles) -> Doubles:
        found_mean, *variances = rounded(*sensor)
        return np.array([found_mean, *np.sqrt(variances)]) - wanted

    start = np.maximum(plain, (mean - 1, 0.2, 0.02))
    bounds = ([mean - 1, 1e-3, 0.0], [mean + 1, 2.0, 4.0])
    found = least_squares(misfit, start, bounds=bounds, xtol=1e-12, ftol=1e-12)
    found_mean, over_time, over_pixels = found.x.tolist()
    return found_mean, over_time, over_pixels


def rounded(mean: float, over_time: float, over_pixels: float) -> tuple[float, float, float]:
    """Return the mean (DN) and the temporal and spatial variance (DN^2) of rounded frames.

    Args:
        mean: the mean before rounding, DN.
        over_time: the deviation of a pixel over time, DN.
        over_pixels: the deviation between pixels, DN.
    """
    from scipy.special import ndtr

    pixels = mean + over_pixels * FINE
    reach = 6 * over_time + 4 * over_pixels + 1
    steps = np.arange(np.floor(mean - reach), np.ceil(mean + reach) + 1)
    above = ndtr((steps + 0.5 - pixels[:, None]) / over_time)
    shares = np.diff(above, axis=1, prepend=0.0)
    means = shares @ steps
    temporal = shares @ (steps * steps) - means * means
    overall = float(FINE_WEIGHTS @ means)
    spatial = float(FINE_WEIGHTS @ np.square(means)) - overall * overall
    return overall, float(FINE_WEIGHTS @ temporal), max(spatial, 0.0)


def noisiest_light(gain: float, read_noise: float, prnu: float, full: float) -> float:
    """Return the light in e- at which temporal noise is largest, before clipping reduces it.

    Args:
        gain: in DN/e-.
        read_noise: in DN.
        prnu: relative.
        full: the light above black at which a pixel or the converter saturates, in DN.

    >>> 0.9 < noisiest_light(0.1, 2.0, 0.005, 4000) / 40000 < 1
    True
    """
    light = SEARCH_RANGE[:, None] * full * np.maximum(1 + prnu * NODES, 0)
    sigma = np.sqrt(gain * light + read_noise**2)
    _, clipped = clipped_normal((full - light) / sigma)
    variance = np.square(sigma * clipped)
    return float(SEARCH_RANGE[np.argmax(variance @ NODE_WEIGHTS)] * full / gain)


def full_well(gain: float, read_noise: float, prnu: float, saturation: float) -> float:
    """Return the full well in e- for which noise is largest at ``saturation`` in e-."""
    well = saturation
    for _ in range(ROUNDS):
        well *= saturation / noisiest_light(gain, read_noise, prnu, gain * well)
    return well
