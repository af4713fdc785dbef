"""Noise parameters of a sensor from its frames: one ISO at a time, then gain stages.

After Bielova et al. (CVPR Workshops 2019): repeated frames of a static scene give each pixel a mean
and a variance, and a line through them is a and b of Var[y] = a*y + b. All is in DN here; a mean of
zero is the black level.
"""

from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any

import numpy as np

from clpipe.analysis.calibration import fixed_pattern, repeats, single_image
from clpipe.analysis.calibration.fixed_pattern import Pixels
from clpipe.analysis.calibration.line_fit import Bin, Estimate, Line, Table, binned, fit_line
from clpipe.analysis.calibration.repeats import CHANNELS, Sensor, Stack
from clpipe.analysis.calibration.single_image import LevelSets
from clpipe.base.errors import ImageError
from clpipe.base.types import Floats

ROUNDING = 1 / 12  # variance of rounding to whole DN
ROUGH = 0.4  # DN of noise below which rounding is not independent of the noise
LEAST_USED = 0.25  # of the pixels
UNALIKE = 0.2  # of the variance about the mean
BENT = 0.1  # of the variance
CLIPPED = 1e-3  # share of a dark frame's samples at 0 DN


@dataclass(frozen=True)
class Calibration:
    """What was found at one ISO; in DN where nothing else is said, None where frames cannot tell.

    ``lines`` are the channels' and ``pooled`` that of all together, before rounding to whole DN.
    """

    iso: float
    sensor: Sensor
    scene_frames: int
    dark_frames: int
    lines: dict[str, Line]
    pooled: Line
    bins: dict[str, tuple[Bin, ...]]
    size: int  # pixels of a frame
    used: float  # the share of them that counts
    rounding: float  # variance of rounding to whole DN, which ``bins`` still have
    row_noise: Estimate | None = None
    column_noise: Estimate | None = None
    dsnu: Estimate | None = None
    prnu: Estimate | None = None  # relative
    hot: Pixels | None = None
    dead: Pixels | None = None
    notes: tuple[str, ...] = ()

    @property
    def method(self) -> str:
        """How a and b were found, in words."""
        if self.scene_frames > 1:
            return "variance over repeated frames"
        return "single image (Foi et al. 2008)"

    @property
    def read_noise(self) -> Estimate:
        """Read noise in DN, and its error where b is not above zero."""
        return self.pooled.floor.root()

    def record(self) -> dict[str, Any]:
        """All of it as JSON values."""
        unit, gain = self.sensor.unit, self.pooled.gain.value
        electrons = self.dsnu and asdict(self.dsnu.scaled(1 / gain))
        return {
            "iso": self.iso,
            "method": self.method,
            "scene_frames": self.scene_frames,
            "dark_frames": self.dark_frames,
            "share_used": self.used,
            "pooled": self.pooled.record(unit),
            "channels": {name: line.record(unit) for name, line in self.lines.items()},
            "row_noise_dn": self.row_noise and asdict(self.row_noise),
            "column_noise_dn": self.column_noise and asdict(self.column_noise),
            "dsnu_e": electrons,
            "prnu": self.prnu and asdict(self.prnu),
            "hot_pixels": self.hot and self.hot.record(),
            "dead_pixels": self.dead and self.dead.record(),
            "notes": list(self.notes),
        }


def calibrate(
    iso: float, scene: Floats, dark: Floats | None, sensor: Sensor, whole: bool = True
) -> Calibration:
    """The noise at one ISO. The frames are used up.

    Args:
        iso: the ISO, for messages.
        scene: (frames, height, width) in DN, of one scene; a single frame is judged alone.
        dark: the same without light, or None.
        sensor: pattern and levels.
        whole: the frames hold whole DN; the variance of rounding is then taken off.

    Raises:
        ImageError: the frames are identical, move, clip or flicker too much, or no line with a
            positive slope goes through them.
    """
    try:
        if len(scene) == 1:
            return _alone(iso, scene[0], dark, sensor, whole)
        return _repeated(iso, scene, dark, sensor, whole)
    except (ImageError, ValueError) as error:
        raise ImageError(f"ISO {iso:g}: {error}") from None


def _alone(
    iso: float, frame: Floats, dark: Floats | None, sensor: Sensor, whole: bool
) -> Calibration:
    """From a single frame of a scene."""
    notes = [
        "a single frame: texture that looks like noise counts as noise; errors do not cover it"
    ]
    rounding = ROUNDING if whole else 0.0
    unit = sensor.unit
    darkness = _Dark.of(dark, sensor, notes)
    known = None
    if darkness and darkness.stack:
        deviation = darkness.temporal.value**0.5 / unit
        known = LevelSets(np.zeros(1), np.array([deviation]), np.array([float(frame.size)]))
    light = frame - np.float32(darkness.level if darkness else sensor.black_level)
    lines, pooled, sets = single_image.single_image(light, sensor, known)
    lines = {name: _positive(line, name).lowered(rounding) for name, line in lines.items()}
    pooled = _seen(pooled).lowered(rounding)
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
        **(darkness.pattern(pooled, rounding) if darkness else {}),
        notes=(*notes, *_doubts(pooled, rounding)),
    )


def _repeated(
    iso: float, scene: Floats, dark: Floats | None, sensor: Sensor, whole: bool
) -> Calibration:
    """From two or more frames of a scene."""
    notes: list[str] = []
    rounding = ROUNDING if whole else 0.0
    _enough(float(((scene > 0) & (scene < sensor.white_level)).mean()))
    top = repeats.ceiling(scene, sensor)
    if top < sensor.white_level:
        notes.append(f"samples clip at {top:g} DN, below the white level of {sensor.white_level:g}")
    darkness = _Dark.of(dark, sensor, notes)
    from_black = replace(sensor, black_level=darkness.level) if darkness else sensor
    stack = repeats.unclipped(repeats.stacked(scene, from_black), None, top)
    _enough(float(stack.used.mean()))
    if darkness:
        stack = stack.without_columns(darkness.columns())
    stack, brighter = repeats.without_flicker(stack)
    if brighter.any():
        spread = f"{brighter.min():+.2%} to {brighter.max():+.2%}"
        notes.append(f"brightness flickers by {spread}; frames were scaled to the same mean")
    line = fit_line(list(stack.tables(stack.variance()).values()))
    hot = darkness.hot if darkness else fixed_pattern.hot_in_scene(stack, line)
    if not darkness and len(hot.rows):
        notes.append(
            "hot pixels are judged on the scene, where a glint of one pixel looks the same"
        )
    dead = fixed_pattern.dead_in_scene(stack, line)
    for bad in (hot, dead):
        stack.used[bad.rows, bad.columns] = False
    stack = repeats.unclipped(stack, line, top)
    _enough(float(stack.used.mean()))
    stacks = [stack, *([darkness.stack] if darkness and darkness.stack else [])]
    row2 = repeats.row_variance([repeats.row_offsets(each, line)[2] for each in stacks])
    line = line.lowered(max(row2.value, 0))
    tables, rows = [], []
    for each in stacks:
        variance, own = repeats.without_rows(each, line)
        tables.append(each.tables(variance))
        rows.append(own)
    line = fit_line([table[name] for table in tables for name in CHANNELS])
    _static(stack, line)
    for each, what in zip(stacks, ("frame", "dark frame"), strict=False):
        _alike(each, line, what)
    lines = {name: _positive(_line(tables, name), name) for name in CHANNELS}
    pooled = _seen(line).lowered(rounding)
    pattern = darkness.pattern(pooled, rounding) if darkness else {}
    dsnu = pattern["dsnu"].value if darkness else 0.0
    bins = {name: binned(table) for name, table in tables[0].items()}
    every = [one for own in bins.values() for one in own]
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
        prnu=prnu2.root() if prnu2 and prnu2.seen else None,
        dead=dead,
        **({"hot": hot} | pattern),
        notes=(*notes, *_doubts(pooled, rounding, lines), *_bent(pooled, rounding, every)),
    )


@dataclass(frozen=True)
class _Dark:
    """Dark frames: their mean and its level in DN, what varies in them, hot pixels.

    ``temporal`` is the variance of a pixel of one frame, row noise apart, rounding included; that
    and ``stack`` are there if two frames or more tell it.
    """

    mean: Floats
    level: float
    frames: int
    hot: Pixels
    stack: Stack | None
    temporal: Estimate
    sensor: Sensor

    @staticmethod
    def of(dark: Floats | None, sensor: Sensor, notes: list[str]) -> "_Dark | None":
        """What dark frames hold, if there are any; what is doubtful of them is noted."""
        if dark is None:
            return None
        mean = dark.mean(axis=0, dtype=np.float64)
        hot = fixed_pattern.hot_in_dark(mean, sensor)
        good = np.ones(mean.shape, bool)
        good[hot.rows, hot.columns] = False
        level = float(mean[good].mean())
        if abs(level - sensor.black_level) > max(1.0, 0.1 * float(dark[0].std())):
            notes.append(
                f"dark frames lie at {level:.2f} DN, not at the black level of "
                f"{sensor.black_level:g}; light is counted from there"
            )
        zeros = float((dark <= 0).mean())
        stack, temporal = None, Estimate(0.0, 0.0)
        if zeros > CLIPPED:
            notes.append(f"{zeros:.1%} of the dark samples are 0 DN; of noise they say nothing")
        elif len(dark) > 1:
            stack = repeats.stacked(dark.copy(), sensor, "dark frames")
            stack.used[hot.rows, hot.columns] = False
            stack.light[...] = stack.around[...] = 0
            rest = stack.rest - stack.rest.mean(axis=2, keepdims=True)
            freedom = stack.used.sum() * stack.degrees * (1 - 1 / mean.shape[1])
            square = float((rest[:, stack.used] ** 2).sum(dtype=np.float64) / freedom)
            temporal = Estimate(square, square * float(np.sqrt(2 / freedom)))
        return _Dark(mean, level, len(dark), hot, stack, temporal, sensor)

    def columns(self) -> Floats:
        """The offset of each column, (width,), DN."""
        good = np.ones(self.mean.shape, bool)
        good[self.hot.rows, self.hot.columns] = False
        return np.mean(self.mean - self.level, axis=0, where=good).astype(np.float32)

    def row_noise(self) -> Estimate | None:
        """Row noise in DN, where there are frames to tell it."""
        if self.stack is None:
            return None
        flat = Line(Estimate(0.0, 0.0), self.temporal, self.mean.size)
        return repeats.row_variance([repeats.row_offsets(self.stack, flat)[2]]).root()

    def pattern(self, pooled: Line, rounding: float) -> dict[str, Any]:
        """Column noise, DSNU and hot pixels."""
        temporal = self.temporal if self.stack else pooled.lowered(-rounding).floor
        left = temporal.scaled(1 / self.frames)
        column2, dsnu2 = fixed_pattern.dark_pattern(self.mean, left, self.hot, self.sensor)
        return {"column_noise": column2.root(), "dsnu": dsnu2.root(), "hot": self.hot}


def _enough(share: float) -> None:
    """See that enough of the pixels count.

    Raises:
        ImageError: they do not.
    """
    if share < LEAST_USED:
        raise ImageError(
            f"{1 - share:.0%} of the pixels are clipped, or so near to it that their noise is; "
            "expose less, or check the levels"
        )


def _static(stack: Stack, line: Line) -> None:
    """See that the frames show the same.

    Raises:
        ImageError: they do not.
    """
    moving = repeats.common_motion(stack, line)
    if moving.value > max(repeats.MOVING, 5 * moving.error):
        share = repeats.share_beyond_noise(stack, line)
        raise ImageError(
            f"the frames do not show the same: neighbouring pixels share {moving.value:.0%} of "
            f"their variance, and {share:.1%} of the pixels vary more than noise does; the scene "
            "or the camera moved, the light changed, or the raws were denoised"
        )


def _alike(stack: Stack, line: Line, what: str) -> None:
    """See that all frames are equally noisy.

    Raises:
        ImageError: one is not.
    """
    noise = repeats.noise_by_frame(stack, line)
    for k, share in enumerate(noise, 1):
        if abs(share - 1) > UNALIKE:
            raise ImageError(
                f"{what} {k} of {len(noise)} (in the order given, folders by name) has {share:.2f} "
                "times the others' variance about the mean; is it a picture without noise, a mean "
                "of frames, or from another setting?"
            )


def _line(tables: Sequence[dict[str, Table]], channel: str) -> Line:
    """The line of one channel.

    Raises:
        ImageError: its pixels define none.
    """
    try:
        return fit_line([table[channel] for table in tables])
    except ValueError as error:
        raise ImageError(f"channel {channel}: {error}") from None


def _positive(line: Line, channel: str) -> Line:
    """The line, if it rises.

    Raises:
        ImageError: it does not.
    """
    if line.gain.value <= 0:
        raise ImageError(
            f"channel {channel}: variance does not rise with light (a = "
            f"{line.gain.value:.3g} +- {line.gain.error:.2g} DN); is it raw, and is the scene both "
            "dark and bright?"
        )
    return line


def _seen(line: Line) -> Line:
    """The line of all channels, if its slope is more than a guess.

    Raises:
        ImageError: it is not.
    """
    if not _positive(line, "of all").gain.seen:
        raise ImageError(
            f"the scene has too little light or range to tell a: found {line.gain.value:.3g} +- "
            f"{line.gain.error:.2g} DN; it should be dark in some places and bright in others"
        )
    return line


def _doubts(pooled: Line, rounding: float, lines: dict[str, Line] | None = None) -> list[str]:
    """What a user should know of a line."""
    found = []
    gain, floor = pooled.gain, pooled.floor
    if gain.error > 0.1 * gain.value:
        found.append(f"a is only known to {gain.error / gain.value:.0%}; give more frames or light")
    if rounding and abs(floor.value) < ROUGH**2:
        found.append(
            f"b is {floor.value:.2f} DN^2; below {ROUGH} DN of noise rounding depends on it, and b "
            "is rough"
        )
    elif floor.value < -2 * floor.error:
        found.append(
            "b is below zero: there is less noise in the dark than a line can have, so the black "
            "level is too low, or the raws were processed"
        )
    elif not floor.seen:
        found.append("b is not above zero by two standard errors; dark frames (--dark) would help")
    for name, line in (lines or {}).items():
        apart = line.gain.value - gain.value
        if abs(apart) > max(5 * line.gain.error, 0.03 * gain.value):
            found.append(f"a of {name} is {apart / gain.value:+.0%} from that of all channels")
    return found


def _bent(pooled: Line, rounding: float, bins: Sequence[Bin]) -> list[str]:
    """What a user should know where the points leave the line."""
    worst, where = 0.0, 0.0
    for one in bins:
        expected = pooled.gain.value * one.light + pooled.floor.value + rounding
        apart = one.variance - expected
        if abs(apart) > max(BENT * expected, 6 * one.error) and abs(apart / expected) > abs(worst):
            worst, where = apart / expected, one.light
    if not worst:
        return []
    return [
        f"variance is {worst:+.0%} from the line at {where:.0f} DN above black; the sensor is not "
        "linear there, or the levels are wrong"
    ]


def gain_stages(found: Sequence[Calibration]) -> list[list[Calibration]]:
    """Calibrations in ascending ISO, cut where another conversion gain sets in.

    Within a gain stage read noise in DN is sqrt((before * K)^2 + after^2), with K the system gain:
    it rises with the ISO. A stage begins where it falls instead, or, with two ISOs in the stage
    before, where it is less than 0.7 of what their law foretells.
    """
    stages: list[list[Calibration]] = []
    for one in sorted(found, key=lambda c: c.iso):
        if stages and one.read_noise.value >= _least_read_noise(stages[-1], one):
            stages[-1].append(one)
        else:
            stages.append([one])
    return stages


def _least_read_noise(stage: Sequence[Calibration], one: Calibration) -> float:
    """The read noise in DN below which an ISO is not of a gain stage."""
    last = stage[-1]
    doubt = 2 * float(np.hypot(last.read_noise.error, one.read_noise.error))
    least = last.read_noise.value - doubt
    if len(stage) > 1:
        gain2 = [c.pooled.gain.value**2 for c in (stage[0], last, one)]
        read2 = [c.read_noise.value**2 for c in (stage[0], last)]
        before2 = max((read2[1] - read2[0]) / (gain2[1] - gain2[0]), 0.0)
        foretold = max(read2[1] + before2 * (gain2[2] - gain2[1]), 0.0)
        least = max(least, 0.7 * float(np.sqrt(foretold)) - doubt)
    return least
