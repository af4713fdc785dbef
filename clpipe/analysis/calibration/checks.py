"""Checks of a calibration, which reject frames or add notes.

The limits are choices. ``tests/test_calibrate.py`` has a case on each side of them.
"""

from collections.abc import Sequence

from clpipe.analysis.calibration import repeats
from clpipe.analysis.calibration.line_fit import Bin, Line, Table, fit_line
from clpipe.analysis.calibration.repeats import Stack
from clpipe.base.errors import ImageError

MIN_VALID_SHARE = 0.25  # share of the pixels that must be valid
# Largest deviation of a frame's variance, relative to the median frame's variance.
MAX_VARIANCE_DEVIATION = 0.2
LOW_NOISE = 0.4  # DN; below this noise, the variance of rounding depends on the noise
MAX_NONLINEARITY = 0.1  # largest deviation of a bin's variance, relative to the line


def check_enough(share: float) -> None:
    """Check that enough of the pixels are valid.

    Raises:
        ImageError: fewer than a quarter are.
    """
    if share < MIN_VALID_SHARE:
        raise ImageError(
            f"{1 - share:.0%} of the pixels, or their noise, are clipped; "
            "expose less, or check the levels"
        )


def check_static(stack: Stack, line: Line) -> None:
    """Check that all frames show the same scene.

    Raises:
        ImageError: neighbouring pixels vary together.
    """
    moving = repeats.common_motion(stack, line)
    if moving.value > max(repeats.MAX_MOTION, 5 * moving.error):
        share = repeats.share_beyond_noise(stack, line)
        raise ImageError(
            f"the frames do not show the same scene: neighbouring pixels share {moving.value:.0%} "
            f"of their variance, and {share:.1%} of the pixels vary more than noise does. The "
            "scene or the camera moved, the light changed, or the raws were denoised"
        )


def check_equal_noise(stack: Stack, line: Line, what: str) -> None:
    """Check that all frames are equally noisy; ``what`` is their name in messages.

    Raises:
        ImageError: a frame is not.
    """
    noise = repeats.noise_by_frame(stack, line)
    for k, share in enumerate(noise, 1):
        if abs(share - 1) > MAX_VARIANCE_DEVIATION:
            raise ImageError(
                f"{what} {k} of {len(noise)} (in the order given, folders by name) has "
                f"{share:.2f} times the variance of the other frames about the mean. Remove "
                "this frame if it is clean, is a mean of frames, or has other camera settings"
            )


def fit_channel(tables: Sequence[dict[str, Table]], channel: str) -> Line:
    """Return the line of one channel.

    Raises:
        ImageError: its pixels do not define a rising line.
    """
    try:
        line = fit_line([table[channel] for table in tables])
    except ValueError as error:
        raise ImageError(f"channel {channel}: {error}") from None
    return check_rising(line, channel)


def check_rising(line: Line, channel: str) -> Line:
    """Return the line, if its variance rises with light.

    Raises:
        ImageError: it does not.
    """
    if line.gain.value <= 0:
        raise ImageError(
            f"channel {channel}: variance does not rise with light (a = {line.gain.value:.3g} +- "
            f"{line.gain.error:.2g} DN). Give raws of a scene that is both dark and bright"
        )
    return line


def check_significant(line: Line) -> Line:
    """Return the line of all channels, if its slope is above two standard errors.

    Raises:
        ImageError: it is not.
    """
    if not check_rising(line, "of all").gain.significant:
        raise ImageError(
            f"the scene has too little light or range to measure a: found {line.gain.value:.3g} +- "
            f"{line.gain.error:.2g} DN; use a scene that is dark in some places and bright in "
            "others"
        )
    return line


def line_notes(pooled: Line, rounding: float, lines: dict[str, Line] | None = None) -> list[str]:
    """Return notes on a line: large errors, noise below rounding, negative b, unequal channels."""
    notes = []
    gain, floor = pooled.gain, pooled.floor
    if gain.error > 0.1 * gain.value:
        notes.append(f"a is known only to {gain.error / gain.value:.0%}; add frames or light")
    if rounding and abs(floor.value) < LOW_NOISE**2:
        notes.append(
            f"b is {floor.value:.2f} DN^2; below {LOW_NOISE} DN of noise, rounding depends on the "
            "noise, so b is inexact"
        )
    elif floor.value < -2 * floor.error:
        notes.append(
            "b is below zero: dark noise is lower than any line allows, so the black "
            "level is too low, or the raws were processed"
        )
    elif not floor.significant:
        notes.append("b is not above zero by two standard errors; add dark frames (--dark)")
    for name, line in (lines or {}).items():
        difference = line.gain.value - gain.value
        if abs(difference) > max(5 * line.gain.error, 0.03 * gain.value):
            notes.append(
                f"a of {name} is {difference / gain.value:+.0%} from the value for all channels"
            )
    return notes


def linearity_notes(pooled: Line, rounding: float, bins: Sequence[Bin]) -> list[str]:
    """Return a note if the variance of a bin is far from the line."""
    worst, light = 0.0, 0.0
    for one in bins:
        expected = pooled.gain.value * one.light + pooled.floor.value + rounding
        apart = one.variance - expected
        if abs(apart) > max(MAX_NONLINEARITY * expected, 6 * one.error) and abs(
            apart / expected
        ) > abs(worst):
            worst, light = apart / expected, one.light
    if not worst:
        return []
    return [
        f"variance is {worst:+.0%} from the line at {light:.0f} DN above black; the sensor is not "
        "linear there, or the levels are wrong"
    ]
