"""The figures of EMVA 1288, release 3.1, each with its standard error."""

from dataclasses import dataclass
from typing import Any

import numpy as np

from clpipe.analysis.calibration.line_fit import Estimate
from clpipe.analysis.emva.moments import Moments, Spatial, Temporal
from clpipe.analysis.emva.series import NS
from clpipe.analysis.report import json_value
from clpipe.base.errors import RequestError
from clpipe.base.types import Doubles, Mask

ROUNDING = 1 / 12  # DN^2; the variance of rounding to whole DN
MIN_DARK_VARIANCE = 0.24  # DN^2; a smaller variance is only due to rounding
FITTED = 0.7  # share of saturation up to which K and R are fitted
LINEAR = 0.05, 0.95  # shares of saturation between which linearity is measured
MOST_AT_ZERO = 0.005  # largest share of dark samples that may be 0
ENOUGH = 3  # the smallest number of exposures for a fit


@dataclass(frozen=True)
class Linearity:
    """The line of mean DN over photons, and the deviations from it in % of the line.

    The slope is in DN per photon, and the offset in DN. There is a deviation for each exposure. The
    least and most are taken between 5 and 95 % of saturation (LE_min and LE_max).
    """

    slope: float
    offset: float
    deviation: Doubles
    used: Mask
    least: Estimate
    most: Estimate


@dataclass(frozen=True)
class NonUniformity:
    """DSNU or PRNU of all pixels, and its parts due to rows, columns and single pixels.

    A part that is not above zero is set to 0, and keeps its error.
    """

    total: Estimate
    row: Estimate
    column: Estimate
    pixel: Estimate


@dataclass(frozen=True)
class Figures:
    """A sensor's figures. ``saturated`` is the number of the exposure at saturation.

    Dark currents are None if there are fewer than three exposure times.
    """

    system_gain: Estimate  # K, DN/e-
    responsivity: Estimate  # R, DN per photon
    quantum_efficiency: Estimate  # electrons per photon
    dark_noise_dn: Estimate  # sigma_y.dark, DN, including rounding
    dark_noise: Estimate  # sigma_d, e-
    threshold: Estimate  # mu_p.min, photons: the light whose SNR is 1
    saturation: Estimate  # mu_p.sat, photons
    saturation_electrons: Estimate  # mu_e.sat
    snr_max: Estimate
    dynamic_range: Estimate
    linearity: Linearity
    dsnu: NonUniformity  # e-
    prnu: NonUniformity  # relative
    dark_current: Estimate | None  # from means, e-/s
    dark_current_of_noise: Estimate | None  # from variances, e-/s
    saturated: int
    fitted: Mask  # exposures that the fit used

    def record(self) -> dict[str, Any]:
        """Return the figures as JSON values, each with its error."""
        values = json_value(self)
        linearity = values.pop("linearity")
        del values["saturated"], values["fitted"]
        return {**values, "linearity_error": {name: linearity[name] for name in ("least", "most")}}


def figures(moments: Moments) -> Figures:
    """Return the figures of a series.

    Raises:
        RequestError: noise without light is clipped, the series has no saturation, or noise does
            not rise with light.
    """
    if moments.dark_stack.at_zero > MOST_AT_ZERO:
        raise RequestError(
            f"{moments.dark_stack.at_zero:.1%} of the samples without light are 0 DN, where "
            f"noise is clipped; EMVA 1288 allows {MOST_AT_ZERO:.1%}. Raise the camera's black level"
        )
    bright, light, noise = moments.bright, moments.light, moments.noise
    saturated = saturation_index(moments)
    fitted = (light <= FITTED * light[saturated]) & (bright.photons <= bright.photons[saturated])
    if fitted.sum() < ENOUGH:
        raise RequestError(
            f"found {fitted.sum()} exposures below {FITTED:.0%} of the saturation; at least "
            f"{ENOUGH} are needed"
        )
    gain = _slope(light[fitted], noise[fitted])
    responsivity = _slope(bright.photons[fitted], light[fitted])
    for name, each in (("variance", gain), ("light", responsivity)):
        if not each.significant:
            raise RequestError(
                f"the {name} does not rise with the exposure; check that all frames are of "
                "one series"
            )
    efficiency = responsivity.over(gain)
    dark2, noise_slope = _dark_variance(moments.dark, moments.dark_stack.mean_frame.size)
    dark_dn = dark2.root()
    dark_noise = Estimate(dark2.value - ROUNDING, dark2.error).root().over(gain)
    # (sigma / K + 1/2) / QE, where sigma is in DN. Most of K cancels.
    least = Estimate(dark_dn.value + gain.value / 2, float(np.hypot(dark_dn.error, gain.error / 2)))
    threshold = least.over(responsivity)
    # The saturation is within half a step of the exposures.
    photons = bright.photons
    step = float(np.ptp(photons[max(saturated - 1, 0) : saturated + 2])) / 2
    saturation = Estimate(float(photons[saturated]), step / 12**0.5)
    electrons = saturation.over(gain.over(responsivity))
    current, of_noise = _dark_current(moments.dark, gain, noise_slope)
    return Figures(
        system_gain=gain,
        responsivity=responsivity,
        quantum_efficiency=efficiency,
        dark_noise_dn=dark_dn,
        dark_noise=dark_noise,
        threshold=threshold,
        saturation=saturation,
        saturation_electrons=electrons,
        snr_max=electrons.root(),
        dynamic_range=saturation.over(threshold),
        linearity=_linearity(moments, saturated),
        dsnu=_dsnu(moments.dark_stack, gain),
        prnu=_prnu(moments.bright_stack, moments.dark_stack),
        dark_current=current,
        dark_current_of_noise=of_noise,
        saturated=saturated,
        fitted=fitted,
    )


def saturation_index(moments: Moments) -> int:
    """Return the number of the exposure at which the noise is greatest.

    Starting with the brightest exposure, it is the first with more noise than the two next darker
    ones, because noise may rise slowly and scatter. Noise below half of the maximum is scatter of
    clipped frames.

    Raises:
        RequestError: it is the brightest exposure.
    """
    variance = moments.bright.variance
    darker = np.maximum(variance[1:-1], variance[:-2])
    peaks = np.flatnonzero((variance[2:] > darker) & (variance[2:] > variance.max() / 2)) + 2
    saturated = int(peaks[-1]) if len(peaks) else int(np.argmax(variance))
    if saturated == len(variance) - 1:
        raise RequestError(
            "the series ends before saturation, because its brightest exposure has the most noise; "
            "add longer exposures"
        )
    return saturated


def _slope(x: Doubles, y: Doubles) -> Estimate:
    """Fit y = slope * x by least squares, and return the slope with an error from residuals."""
    squares = float(x @ x)
    slope = float(x @ y) / squares
    residuals = y - slope * x
    return Estimate(slope, float(np.sqrt(residuals @ residuals / (len(x) - 1) / squares)))


def _line(x: Doubles, y: Doubles) -> tuple[Estimate, Estimate]:
    """Fit a line by least squares, and return slope and offset with errors from residuals."""
    (slope, offset), covariance = np.polyfit(x, y, 1, cov=True)
    slope_error, offset_error = np.sqrt(np.diag(covariance))
    return Estimate(float(slope), float(slope_error)), Estimate(float(offset), float(offset_error))


def _dark_variance(dark: Temporal, pixels: int) -> tuple[Estimate, Estimate | None]:
    """Return the variance without light at no exposure, DN^2, and its slope, DN^2/ns.

    With fewer than three exposure times, it is the variance at the shortest.
    """
    if len(np.unique(dark.time)) < ENOUGH:
        variance = float(dark.variance[np.argmin(dark.time)])
        found, slope = Estimate(variance, variance * (2 / pixels) ** 0.5), None
    else:
        # Times are in ms, so that squares do not lose precision.
        per_ms, found = _line(dark.time / 1e6, dark.variance)
        slope = per_ms.scaled(1e-6)
    return (found if found.value > MIN_DARK_VARIANCE else Estimate(MIN_DARK_VARIANCE, 0.0)), slope


def _dark_current(
    dark: Temporal, gain: Estimate, noise_slope: Estimate | None
) -> tuple[Estimate | None, Estimate | None]:
    """Return the dark current in e-/s, from means and from variances."""
    if noise_slope is None:
        return None, None
    of_mean = _line(dark.time / 1e6, dark.mean)[0].scaled(1e-6)
    return (
        of_mean.scaled(NS).over(gain),
        noise_slope.scaled(NS / gain.value).over(gain),
    )


def _linearity(moments: Moments, saturated: int) -> Linearity:
    """Return the line of least squares of relative deviations, and the deviations."""
    light, photons = moments.light, moments.bright.photons
    low, high = (share * light[saturated] for share in LINEAR)
    used = (light >= low) & (light <= high) & (photons <= photons[saturated])
    if used.sum() < ENOUGH:
        raise RequestError(
            f"found {used.sum()} exposures between {LINEAR[0]:.0%} and {LINEAR[1]:.0%} of the "
            f"saturation; at least {ENOUGH} are needed"
        )
    slope, offset = np.polyfit(photons[used], light[used], 1, w=1 / light[used])
    line = slope * photons + offset
    deviation = 100 * (light / line - 1)
    # Variation of the light source or the sensor between two frames, halved because the mean of
    # both is used.
    wavering = 100 * moments.bright.flicker[used] / 2 / line[used]
    error = float(np.sqrt(np.square(wavering).mean()))
    least, most = (Estimate(float(f(deviation[used])), error) for f in (np.min, np.max))
    return Linearity(float(slope), float(offset), deviation, used, least, most)


def _dsnu(dark: Spatial, gain: Estimate) -> NonUniformity:
    """Return the deviation of pixels without light, e-."""
    parts = (dark.variance, *dark.parts)
    return NonUniformity(*(part.root().over(gain) for part in parts))


def _prnu(bright: Spatial, dark: Spatial) -> NonUniformity:
    """Return the relative deviation of pixels at half the saturation, minus that without light."""
    light = bright.mean - dark.mean
    lit, unlit = (bright.variance, *bright.parts), (dark.variance, *dark.parts)
    of_light = (
        Estimate(b.value - d.value, float(np.hypot(b.error, d.error)))
        for b, d in zip(lit, unlit, strict=True)
    )
    return NonUniformity(*(part.root().scaled(1 / light) for part in of_light))
