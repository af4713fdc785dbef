"""Estimates the noise parameters of a sensor from its frames, one ISO at a time.

The method comes from Bielova et al. (CVPR Workshops 2019). Repeated frames of a static scene give
each pixel a mean and a variance. A line through them gives a and b of Var[y] = a*y + b. Values are
in DN, and light is counted from the black level.
"""

from dataclasses import replace

import numpy as np

from clpipe.analysis.calibration import fixed_pattern, repeats, single_image
from clpipe.analysis.calibration.checks import (
    check_enough,
    check_equal_noise,
    check_rising,
    check_significant,
    check_static,
    fit_channel,
    line_notes,
    linearity_notes,
)
from clpipe.analysis.calibration.dark import DarkFrames
from clpipe.analysis.calibration.dark_figures import DarkFigures, dark_figures
from clpipe.analysis.calibration.line_fit import Bin, binned, fit_line
from clpipe.analysis.calibration.repeats import Sensor
from clpipe.analysis.calibration.result import Calibration
from clpipe.analysis.calibration.single_image import LevelSets
from clpipe.base.errors import ImageError
from clpipe.base.types import Floats

ROUNDING = 1 / 12  # DN^2; the variance of rounding to whole DN


def calibrate(
    iso: float, scene: Floats, dark: Floats | None, sensor: Sensor, whole: bool = True
) -> Calibration:
    """Estimate the noise at one ISO. The frames are overwritten.

    Args:
        iso: the ISO, for messages.
        scene: frames of one static scene, or a single frame, in DN: (frames, height, width).
        dark: frames without light, in the same form, or None.
        sensor: pattern and levels.
        whole: whether the frames have whole DN, so that the variance of rounding is subtracted.

    Raises:
        ImageError: the frames are identical, move, clip or flicker too much, or no line with a
            positive slope fits them.
    """
    try:
        if len(scene) == 1:
            return _from_single_frame(iso, scene[0], dark, sensor, whole)
        return _from_repeats(iso, scene, dark, sensor, whole)
    except (ImageError, ValueError) as error:
        raise ImageError(f"ISO {iso:g}: {error}") from None


def figures_of(
    dark: Floats | None, sensor: Sensor, darkness: DarkFrames | None
) -> DarkFigures | None:
    """Return figures of dark frames other than read noise; None if the frames do not allow it."""
    if dark is None or darkness is None or (len(dark) > 1 and darkness.stack is None):
        return None
    return dark_figures(dark, sensor, darkness.hot)


def _from_single_frame(
    iso: float, frame: Floats, dark: Floats | None, sensor: Sensor, whole: bool
) -> Calibration:
    """Estimate the noise from a single frame of a scene; see :func:`calibrate`."""
    notes = [
        "a single frame: texture that looks like noise counts as noise; errors do not cover it"
    ]
    rounding = ROUNDING if whole else 0.0
    unit = sensor.unit
    darkness = DarkFrames.analyse(dark, sensor, notes)
    figures = figures_of(dark, sensor, darkness)
    dark_set = None
    if darkness and darkness.stack:
        deviation = darkness.temporal.value**0.5 / unit
        dark_set = LevelSets(np.zeros(1), np.array([deviation]), np.array([float(frame.size)]))
    light = frame - np.float32(darkness.level if darkness else sensor.black_level)
    lines, pooled, sets = single_image.single_image(light, sensor, dark_set)
    lines = {name: check_rising(line, name).lowered(rounding) for name, line in lines.items()}
    pooled = check_significant(pooled).lowered(rounding)
    pattern = darkness.pattern(pooled, rounding) if darkness else None
    variance = (sets.deviation * unit) ** 2
    points = zip(
        sets.mean * unit, variance, variance * np.sqrt(2 / sets.count), sets.count, strict=True
    )
    return Calibration(
        iso=iso,
        sensor=sensor,
        scene_frames=1,
        dark_frames=0 if dark is None else len(dark),
        lines=lines,
        pooled=pooled,
        bins={"all": tuple(Bin(float(m), float(v), float(e), int(n)) for m, v, e, n in points)},
        size=light.size,
        used=min(pooled.pixels / light.size, 1.0),
        rounding=rounding,
        row_noise=darkness.row_noise() if darkness else None,
        column_noise=pattern.column_noise if pattern else None,
        dsnu=pattern.dsnu if pattern else None,
        hot=pattern.hot if pattern else None,
        dark=figures,
        notes=(*notes, *line_notes(pooled, rounding)),
    )


def _from_repeats(
    iso: float, scene: Floats, dark: Floats | None, sensor: Sensor, whole: bool
) -> Calibration:
    """Estimate the noise from two or more frames of a scene; see :func:`calibrate`."""
    notes: list[str] = []
    rounding = ROUNDING if whole else 0.0
    check_enough(float(((scene > 0) & (scene < sensor.white_level)).mean()))
    top = repeats.clipping_level(scene, sensor)
    if top < sensor.white_level:
        notes.append(f"samples clip at {top:g} DN, below the white level of {sensor.white_level:g}")
    darkness = DarkFrames.analyse(dark, sensor, notes)
    figures = figures_of(dark, sensor, darkness)
    from_black = replace(sensor, black_level=darkness.level) if darkness else sensor
    stack = repeats.unclipped(repeats.stack_frames(scene, from_black), None, top)
    check_enough(float(stack.used.mean()))
    if darkness:
        stack = stack.without_columns(darkness.columns())
    stack, brighter = repeats.without_flicker(stack)
    if brighter.any():
        spread = f"{brighter.min():+.2%} to {brighter.max():+.2%}"
        notes.append(f"brightness flickers by {spread}; frames were scaled to the same mean")
    # Fit a first line, which includes row noise, to find bad and clipped pixels.
    line = fit_line(list(stack.tables(stack.variance()).values()))
    hot = darkness.hot if darkness else fixed_pattern.hot_in_scene(stack, line)
    if not darkness and len(hot.rows):
        notes.append("hot pixels are found in the scene, where a glint of one pixel looks the same")
    dead = fixed_pattern.dead_in_scene(stack, line)
    for bad in (hot, dead):
        stack.used[bad.rows, bad.columns] = False
    stack = repeats.unclipped(stack, line, top)
    check_enough(float(stack.used.mean()))
    # Fit a second line after subtracting the offsets of rows.
    stacks = [stack, *([darkness.stack] if darkness and darkness.stack else [])]
    row2 = repeats.row_variance([repeats.row_offsets(each, line)[2] for each in stacks])
    line = line.lowered(max(row2.value, 0))
    tables, rows = [], []
    for each in stacks:
        variance, own_rows = repeats.without_rows(each, line)
        tables.append(each.tables(variance))
        rows.append(own_rows)
    line = fit_line([table[name] for table in tables for name in sensor.channels])
    check_static(stack, line)
    for each, what in zip(stacks, ("frame", "dark frame"), strict=False):
        check_equal_noise(each, line, what)
    lines = {name: fit_channel(tables, name) for name in sensor.channels}
    pooled = check_significant(line).lowered(rounding)
    pattern = darkness.pattern(pooled, rounding) if darkness else None
    dsnu = pattern.dsnu.value if pattern else 0.0
    bins = {name: binned(table) for name, table in tables[0].items()}
    all_bins = [one for own_bins in bins.values() for one in own_bins]
    prnu2 = fixed_pattern.response_pattern(stack, line, dsnu**2)
    return Calibration(
        iso=iso,
        sensor=sensor,
        scene_frames=len(scene),
        dark_frames=0 if dark is None else len(dark),
        lines={name: own.lowered(rounding) for name, own in lines.items()},
        pooled=pooled,
        bins=bins,
        size=stack.light.size,
        used=float(stack.used.mean()),
        rounding=rounding,
        row_noise=repeats.row_variance(rows).root(),
        column_noise=pattern.column_noise if pattern else None,
        dsnu=pattern.dsnu if pattern else None,
        prnu=prnu2.root() if prnu2 and prnu2.significant else None,
        hot=hot,
        dead=dead,
        dark=figures,
        notes=(
            *notes,
            *line_notes(pooled, rounding, lines),
            *linearity_notes(pooled, rounding, all_bins),
        ),
    )
