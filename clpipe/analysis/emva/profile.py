"""Makes a camera profile from the figures of a series: TOML text, with sources."""

from typing import Any

from clpipe.analysis.calibration.dark_profile import plus_minus
from clpipe.analysis.emva.figures import MIN_DARK_VARIANCE, ROUNDING, Figures, NonUniformity
from clpipe.analysis.emva.moments import Moments
from clpipe.analysis.emva.sensor import before_rounding, full_well, noisiest_light
from clpipe.camera.text import profile_text


def emva_profile(name: str, iso: float, source: str, moments: Moments, figures: Figures) -> str:
    """Return the text of a profile, which :func:`clpipe.camera.profile.load_camera` reads.

    Differences between rows, or over wide areas, count as differences of single pixels, so that
    DSNU and PRNU of all pixels match the sensor.

    Args:
        name: the name of the profile.
        iso: the ISO for the setting of the series; the standard does not define one.
        source: the series, for the sources.
        moments: the moments of the series.
        figures: the figures of the series.
    """
    dark = moments.dark_stack
    dark2 = figures.dark_noise_dn.value**2
    temporal = dark.temporal if dark2 <= MIN_DARK_VARIANCE else dark2
    black, read_noise, pattern = before_rounding(dark.mean, temporal, dark.variance.value)
    # If rounding reduces dark noise, the fitted line of K is tilted, because it goes through zero.
    used = moments.light[figures.fitted]
    hidden = read_noise**2 + ROUNDING - temporal
    gain = figures.system_gain.value - hidden * float(used.sum() / (used @ used))
    efficiency = figures.responsivity.value / gain
    prnu, light = figures.prnu.total.value, moments.white - black
    saturation = figures.saturation.scaled(efficiency)
    stripes = dark.stripes
    share = stripes.value / max(dark.variance.value, stripes.value) if stripes.significant else 0
    column2 = share * pattern**2
    values: dict[str, Any] = {
        "name": name,
        "make": "unknown",
        "model": name,
        "black_level": black,
        "white_level": moments.white,
        "white_balance_gains": (1.0, 1.0),
        "filter_array": "mono",
        "iso_range": (iso, iso),
        "quantum_efficiency": min(efficiency, 1.0),
        "prnu": prnu,
        "dsnu": (pattern**2 - column2) ** 0.5 / gain,
    }
    of_converter = noisiest_light(gain, read_noise, prnu, light)
    # A step of the exposures is 12^(1/2) standard errors wide.
    is_converter = of_converter < saturation.value + 12**0.5 * saturation.error
    well = f"noise is greatest at {plus_minus(saturation, 'e-')}"
    if is_converter:
        well += ", where the converter ends"
    else:
        values["full_well"] = full_well(gain, read_noise, prnu, saturation.value)
        well += f", {of_converter - saturation.value:.0f} e- before the converter ends"
    current = figures.dark_current
    if current and current.significant:
        values["dark_current"] = current.value
    stage = {
        "iso": [iso],
        "system_gain": [gain],
        "read_noise": [read_noise],
        "column_noise": [column2**0.5],
    }
    sources = {
        "gain_stages": f"EMVA 1288 (release 3.1), {source}: K "
        f"{plus_minus(figures.system_gain, 'DN/e-')}, dark noise "
        f"{plus_minus(figures.dark_noise, 'e-')}; ISO {iso:g} denotes the setting of the "
        "series",
        "levels": "black: the mean of the frames without light, before they were rounded; white: "
        "the largest value of a frame",
        "white_balance_gains": "not known; assumed to be 1",
        "filter_array": "not stated in a series; assumed to have no filters",
        "xyz_to_camera": "not known: a series has no colours",
        "quantum_efficiency": "at the light of the series: "
        f"{plus_minus(figures.quantum_efficiency)}"
        + ("; it cannot exceed 1, so the profile has 1" if efficiency > 1 else ""),
        "full_well": well,
        "prnu": f"PRNU1288: {_parts(figures.prnu, '')}; all of it drawn for each pixel",
        "dsnu": f"DSNU1288: {_parts(figures.dsnu, 'e-')}; the part that "
        "is not column noise is drawn for each pixel",
        "column_noise": "differences of neighbouring columns without light: "
        f"{plus_minus(stripes.root(), 'DN')}, with rounding",
        "dark_current": f"slope of the means without light: {plus_minus(current, 'e-/s')}; at the "
        "temperature of the series, assumed to be 20 deg C"
        if current
        else "not known: it takes three or more exposure times",
        "linearity": "the sensor is off a line by "
        f"{figures.linearity.least.value:+.2f} to {figures.linearity.most.value:+.2f} %; the "
        "profile is linear",
        "fixed_pattern": "hot and dead pixels, row noise: not known; assumed to be zero",
    }
    return profile_text(values, [stage], sources)


def _parts(figure: NonUniformity, unit: str) -> str:
    """Return a non-uniformity with its parts, for the sources."""
    parts = {"rows": figure.row, "columns": figure.column, "single pixels": figure.pixel}
    each = ", ".join(f"{name} {plus_minus(part, unit)}" for name, part in parts.items())
    return f"{plus_minus(figure.total, unit)} ({each})"
