"""A profile's values for dark frames, from calibrations, with their sources; None is unknown."""

from collections.abc import Mapping, Sequence

import numpy as np

from clpipe.analysis.calibration.dark_figures import slope_and_offset
from clpipe.analysis.calibration.line_fit import Estimate, weighted
from clpipe.analysis.calibration.result import Calibration

Sourced = dict[str, tuple[float | None, str]]
UNKNOWN = "not known: "


def plus_minus(estimate: Estimate, unit: str = "") -> str:
    """Return a value with its error as text, or an upper limit if it is not significant.

    >>> plus_minus(Estimate(1.41, 0.012), "DN"), plus_minus(Estimate(0.0, 0.1), "DN")
    ('1.41 +- 0.012 DN', 'not seen, below 0.2 DN')
    >>> plus_minus(Estimate(-5.0, 0.1))  # below zero only by chance or drift
    'not seen, below 0.2'
    """
    unit = unit and f" {unit}"
    if not estimate.significant:
        return f"not seen, below {max(estimate.value, 0) + 2 * estimate.error:.2g}{unit}"
    return f"{estimate.value:.4g} +- {estimate.error:.2g}{unit}"


def dark_values(calibrations: Sequence[Calibration]) -> Sourced:
    """Return the keys of a profile that apply at all ISOs, and the sources of keys by ISO."""
    found = {**_telegraph(calibrations), **_wave(calibrations), **_shading(calibrations)}
    darks = {c.iso: c.dark for c in calibrations if c.dark}
    for key, unit in (("tukey_lambda", ""), ("black_level_error", "DN")):
        own = {iso: _signed(e, unit) for iso, d in darks.items() if (e := getattr(d, key))}
        source = f"dark frames: {at_isos(own)}" if own else f"{UNKNOWN}too few dark frames"
        found[key] = None, source
    biases = {iso: ", ".join(_signed(e, "") for e in d.color_bias) for iso, d in darks.items()}
    source = "means of dark frames by colour, less the black level: "
    source += at_isos({iso: f"{text} DN" for iso, text in biases.items()})
    found["color_bias"] = None, source if darks else f"{UNKNOWN}no dark frames"
    found |= _current(calibrations)
    found["crosstalk"] = None, f"{UNKNOWN}frames of edges or of one colour would tell it"
    return found


def at_isos(texts: Mapping[float, str]) -> str:
    """Return texts by ISO as one text.

    >>> at_isos({100: "1 DN", 200: "2 DN"})
    'ISO 100 1 DN; ISO 200 2 DN'
    """
    return "; ".join(f"ISO {iso:g} {text}" for iso, text in texts.items())


def _signed(estimate: Estimate, unit: str) -> str:
    return f"{estimate.value:.3g} +- {estimate.error:.2g}{unit and ' '}{unit}"


def _current(calibrations: Sequence[Calibration]) -> Sourced:
    keys = ("dark_current", "dark_current_spread")
    own = [c.dark_current for c in calibrations if c.dark_current]
    if not own:
        why = f"{UNKNOWN}it takes two or more dark frames at each of two or more exposure times"
        return dict.fromkeys(keys, (None, why))
    current = weighted([each.current for each in own])
    times = ", ".join(f"{t:g}" for t in sorted({t for each in own for t in each.times}))
    source = f"noise and pattern of dark frames of {times} s: "
    spreads = [each.spread for each in own if each.spread]
    spread = weighted(spreads) if spreads and current.significant else None
    where = "; at the temperature of the frames, assumed to be 20 deg C"
    return {
        keys[0]: (
            current.value if current.significant else None,
            source + plus_minus(current, "e-/s") + where,
        ),
        keys[1]: (
            min(spread.value, 1.0) if spread and spread.significant else None,
            source + plus_minus(spread) if spread else f"{UNKNOWN}no dark current was seen",
        ),
    }


def _telegraph(calibrations: Sequence[Calibration]) -> Sourced:
    own = [
        (c.dark.rts_share, c.dark.rts_amplitude.scaled(1 / c.pooled.gain.value), c.iso)
        for c in calibrations
        if c.dark and c.dark.rts_share and c.dark.rts_amplitude
    ]
    if not own:
        why = f"{UNKNOWN}no pixels that jump were seen in 8 or more dark frames of an ISO"
        return {"rts_share": (None, why), "rts_amplitude": (None, why)}
    share, amplitude = weighted([each[0] for each in own]), weighted([each[1] for each in own])
    isos = ", ".join(f"{iso:g}" for _, _, iso in own)
    source = f"pixels whose dark frames differ most, ISO {isos}: "
    return {
        "rts_share": (share.value, source + plus_minus(share)),
        "rts_amplitude": (amplitude.value, source + plus_minus(amplitude, "e-")),
    }


def _wave(calibrations: Sequence[Calibration]) -> Sourced:
    own = [
        (c.dark.banding.amplitude.scaled(1 / c.pooled.gain.value), c.dark.banding.period)
        for c in calibrations
        if c.dark and c.dark.banding
    ]
    if not own:
        why = f"{UNKNOWN}no wave stands out of the means of rows of dark frames"
        return {"banding_amplitude": (None, why), "banding_period": (None, why)}
    amplitude = weighted([each[0] for each in own])
    period = max(own, key=lambda each: each[0].value / each[0].error)[1]
    source = f"the peak of the spectrum of rows of dark frames: {plus_minus(amplitude, 'e-')}"
    return {"banding_amplitude": (amplitude.value, source), "banding_period": (period, source)}


def _shading(calibrations: Sequence[Calibration]) -> Sourced:
    keys = ("dark_shading_slope", "dark_shading_offset", "dark_shading_length")
    own = {c.iso: c.dark.shading for c in calibrations if c.dark and c.dark.shading}
    if not own:
        return dict.fromkeys(keys, (None, f"{UNKNOWN}no dark frames of 192 px or more each way"))
    slope, offset = (
        slope_and_offset(own)
        if len(own) > 1
        else (Estimate(0.0, 0.0), next(iter(own.values())).variance.root())
    )
    isos = ", ".join(f"{iso:g}" for iso in own)
    source = f"the smooth part of mean dark frames, ISO {isos}: "
    length = float(np.median([each.length for each in own.values()]))
    seen = slope.significant or offset.significant
    return {
        keys[0]: (
            slope.value if slope.significant else None,
            source + (plus_minus(slope, "DN for each ISO") if len(own) > 1 else "one ISO alone"),
        ),
        keys[1]: (offset.value if offset.significant else None, source + plus_minus(offset, "DN")),
        keys[2]: (length if seen else None, source + "where its correlation is a half"),
    }
