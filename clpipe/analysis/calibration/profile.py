"""Makes a camera profile from calibrations: TOML text, with the source of each value."""

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from clpipe.analysis.calibration.dark_profile import at_isos, dark_values, plus_minus
from clpipe.analysis.calibration.gain_stages import gain_stages
from clpipe.analysis.calibration.line_fit import Estimate, weighted
from clpipe.analysis.calibration.result import Calibration
from clpipe.camera.profile import Matrix
from clpipe.camera.text import profile_text

Gains = tuple[float, float]


def calibrated_profile(
    name: str,
    make: str,
    model: str,
    calibrations: Sequence[Calibration],
    gains: Gains | None = None,
    xyz_to_camera: Matrix | None = None,
) -> str:
    """Return the text of a profile, which :func:`clpipe.camera.profile.load_camera` reads.

    Args:
        name: the name of the profile.
        make: the make of the camera.
        model: the model of the camera.
        calibrations: one calibration for each ISO, at least one, all of one sensor.
        gains: white balance gains of red and blue (green = 1), if the frames state them.
        xyz_to_camera: the camera's matrix, if the frames state it.
    """
    calibrations = sorted(calibrations, key=lambda c: c.iso)
    sensor = calibrations[0].sensor
    values: dict[str, Any] = {
        "name": name,
        "make": make,
        "model": model,
        "black_level": sensor.black_level,
        "white_level": sensor.white_level,
        "white_balance_gains": gains or (1.0, 1.0),
    }
    if sensor.filter_array:
        values["filter_array"] = sensor.filter_array
    if xyz_to_camera:
        values["xyz_to_camera"] = xyz_to_camera
    sources = {
        "gain_stages": _gain_source(calibrations),
        "levels": "as stated by the frames or the options",
        "white_balance_gains": "as stated by the frames" if gains else "not known; assumed to be 1",
        "xyz_to_camera": "as stated by the frames" if xyz_to_camera else "not known",
        "full_well": f"not known; {_white_in_electrons(calibrations[0])}",
    }
    values["iso_range"] = (calibrations[0].iso, calibrations[-1].iso)
    for key, (value, source) in {
        **_fixed_pattern(calibrations),
        **dark_values(calibrations),
    }.items():
        if value is not None:
            values[key] = value
        sources[key] = source
    for key in ("row_noise", "column_noise"):
        sources[key] = _line_source(calibrations, key)
    stages = map(_stage_tables, gain_stages(calibrations))
    return profile_text(values, list(stages), sources)


def _stage_tables(stage: Sequence[Calibration]) -> dict[str, list[Any]]:
    """Return the tables of a gain stage in the profile, without those that lack an ISO."""
    darks = [c.dark for c in stage]
    shapes = [d.tukey_lambda if d else None for d in darks]
    errors = [d.black_level_error if d else None for d in darks]
    tables: Mapping[str, list[Any]] = {
        "iso": [c.iso for c in stage],
        "system_gain": [c.pooled.gain.value for c in stage],
        "read_noise": [read_noise(c) for c in stage],
        "row_noise": [_significant(c.row_noise) for c in stage],
        "column_noise": [_significant(c.column_noise) for c in stage],
        "tukey_lambda": [shape and shape.value for shape in shapes],
        "black_level_error": [_significant(error) for error in errors],
        "color_bias": [d and [each.value for each in d.color_bias] for d in darks],
    }
    known = {key: [v for v in row if v is not None] for key, row in tables.items()}
    return {key: row for key, row in known.items() if len(row) == len(stage)}


def read_noise(one: Calibration) -> float:
    """Return the read noise in DN; if b is not above zero, the root of b's standard error."""
    own = one.read_noise
    return own.value or own.error


def _significant(estimate: Estimate | None) -> float | None:
    """Return the value, or 0 if it is not above zero by two standard errors; None if unknown."""
    return None if estimate is None else estimate.value if estimate.significant else 0.0


def _gain_source(calibrations: Sequence[Calibration]) -> str:
    """Return the source of system gain and read noise: method, frames and values at each ISO."""
    parts = []
    for c in calibrations:
        frames = f"{c.scene_frames} frame{'s' if c.scene_frames > 1 else ''}"
        if c.dark_frames:
            frames += f" and {c.dark_frames} dark"
        gain, read = plus_minus(c.pooled.gain, "DN/e-"), plus_minus(c.read_noise, "DN")
        parts.append(f"ISO {c.iso:g}: {c.method}, {frames}, gain {gain}, read noise {read}")
    text = "clpipe calibrate; read noise of a pixel without row noise and rounding; "
    return text + "; ".join(parts)


def _line_source(calibrations: Sequence[Calibration], key: str) -> str:
    """Return the source of row or column noise."""
    estimates = {c.iso: plus_minus(e, "DN") for c in calibrations if (e := getattr(c, key))}
    if not estimates:
        needs = "two frames" if key == "row_noise" else "dark frames"
        return f"not known without {needs}; assumed to be zero"
    what = "means of rows" if key == "row_noise" else "means of columns of the mean dark frame"
    return f"{what}, corrected for pixel noise: {at_isos(estimates)}"


def _white_in_electrons(lowest: Calibration) -> str:
    """Return the charge at the white level of the lowest ISO, as text."""
    electrons = lowest.sensor.unit / lowest.pooled.gain.value
    return f"at ISO {lowest.iso:g} the white level is {electrons:.0f} e-, and the ADC clips there"


def _fixed_pattern(calibrations: Sequence[Calibration]) -> dict[str, tuple[float | None, str]]:
    """Return PRNU, DSNU, hot and dead pixels by key: the value (None if unknown) and its source."""
    result: dict[str, tuple[float | None, str]] = {}
    prnu = [c.prnu for c in calibrations if c.prnu]
    result["prnu"] = (None, "not known: no scene was flat enough, or it was not significant")
    if prnu:
        mean = weighted(prnu)
        result["prnu"] = mean.value, f"flat places of the mean frame: {plus_minus(mean)}"
    dsnu = {c.iso: c.dsnu.scaled(1 / c.pooled.gain.value) for c in calibrations if c.dsnu}
    result["dsnu"] = (None, "not known without dark frames")
    if dsnu:
        each = at_isos({iso: plus_minus(e, "e-") for iso, e in dsnu.items()})
        source = f"pixels of the mean dark frame, temporal noise subtracted: {each}"
        result["dsnu"] = _significant(weighted(list(dsnu.values()))), source
    result |= _hot(calibrations)
    judged = [c for c in calibrations if c.dead and c.dead.seen_on > 0.05]
    result["dead_pixel_share"] = (None, "not known: too little light in the frames")
    if judged:
        best = max(judged, key=lambda c: c.dead.seen_on if c.dead else 0)
        assert best.dead
        share = len(best.dead.rows) / (best.dead.seen_on * best.size)
        source = f"{len(best.dead.rows)} dark among bright neighbours at ISO {best.iso:g}, "
        source += f"on the {best.dead.seen_on:.0%} of the pixels that had enough light to judge"
        result["dead_pixel_share"] = share, source
    return result


def _hot(calibrations: Sequence[Calibration]) -> dict[str, tuple[float | None, str]]:
    """Return hot pixels like _fixed_pattern, from the dark frames of the ISO with most of them."""
    judged = [c for c in calibrations if c.hot and c.dark_frames]
    if not judged:
        candidates = max((len(c.hot.rows) for c in calibrations if c.hot), default=0)
        source = "not known without dark frames"
        if candidates:
            source += f"; {candidates} pixels of a scene look hot, but so does a glint of one pixel"
        return {"hot_pixel_share": (None, source), "hot_pixel_level": (None, source)}
    best = max(judged, key=lambda c: len(c.hot.rows) if c.hot else 0)
    assert best.hot
    count = len(best.hot.rows)
    source = f"{count} among {best.size} pixels, dark frames of ISO {best.iso:g}"
    share = (count / best.size, source)
    if not count:
        return {"hot_pixel_share": share}
    # The median of level * (1 + Exp(1)) is level * (1 + ln 2), even if the hottest pixels clip.
    median = float(np.median(best.hot.excess))
    level = median / best.pooled.gain.value / (1 + math.log(2))
    source = f"median charge of {count} hot pixels over 1 + ln 2, the median of 1 + Exp(1)"
    if median > 0.95 * best.sensor.unit:
        source += "; most of them clip, so the true level is higher"
    return {"hot_pixel_share": share, "hot_pixel_level": (level, source)}
