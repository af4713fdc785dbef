"""Dark current from dark frames of several exposure times.

Cameras subtract the mean dark charge with their black level. Dark current is therefore estimated
from its shot noise and its pattern (EMVA 1288, release 4.0, 2021, describes both methods).
"""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from clpipe.analysis.calibration.dark_figures import without_rows
from clpipe.analysis.calibration.fixed_pattern import NO_PIXELS, dark_pattern
from clpipe.analysis.calibration.line_fit import Estimate
from clpipe.analysis.calibration.repeats import Sensor
from clpipe.analysis.report import json_object
from clpipe.base.types import Doubles, Floats

MIN_TIMES = 2


@dataclass(frozen=True)
class DarkCurrent:
    """The dark current at the frames' temperature, and its spread over pixels."""

    current: Estimate  # e-/s
    spread: Estimate | None  # standard deviation over mean; None if no current is measured
    times: tuple[float, ...]  # s

    def record(self) -> dict[str, object]:
        """Return the figures as JSON values."""
        return json_object(current_e_per_s=self.current, spread=self.spread, times_s=self.times)


def dark_current(
    stacks: Mapping[float, Floats], gain: Estimate, sensor: Sensor
) -> DarkCurrent | None:
    """Return the dark current of frames of one ISO and temperature; None for fewer than two times.

    Temporal variance rises by gain^2 * current per second. The variance of the pattern rises by the
    square of gain * current * spread per squared second.

    Args:
        stacks: dark frames in DN by exposure time in s: (two or more frames, height, width).
        gain: the system gain in DN/e-.
        sensor: the sensor, for its filter array.
    """
    stacks = {time: frames for time, frames in sorted(stacks.items()) if len(frames) > 1}
    if len(stacks) < MIN_TIMES:
        return None
    times = np.array(list(stacks))
    temporal, patterns = zip(
        *(variances(frames, sensor) for frames in stacks.values()), strict=True
    )
    slope = slope_of(times, temporal)
    factor = 1 / gain.value**2
    relative = np.hypot(slope.error / max(abs(slope.value), 1e-12), 2 * gain.error / gain.value)
    value = slope.value * factor
    current = Estimate(value, max(abs(value) * float(relative), slope.error * factor))
    spread = None
    if current.significant:
        rise = slope_of(times**2, patterns).root()
        own = rise.value / (gain.value * current.value)
        share = np.hypot(rise.error / max(rise.value, 1e-12), current.error / current.value)
        spread = (
            Estimate(own, own * float(share)) if rise.significant else Estimate(0.0, float(share))
        )
    return DarkCurrent(current, spread, tuple(float(t) for t in times))


def variances(frames: Floats, sensor: Sensor) -> tuple[Estimate, Estimate]:
    """Return the temporal variance of a pixel and the variance of the pixels' pattern, in DN^2.

    Both exclude the noise of rows and columns.
    """
    count = len(frames)
    mean = frames.mean(axis=0, dtype=np.float64)
    rest = without_rows(
        (frames - mean.astype(np.float32)) * np.float32((count / (count - 1)) ** 0.5)
    )
    of_pixels = rest.var(axis=0, dtype=np.float64)
    in_time = float(of_pixels.mean())
    freedom = of_pixels.size * (count - 1)
    scatter = float(of_pixels.std()) / of_pixels.size**0.5
    left = Estimate(in_time / count, 0.0)
    _, pattern = dark_pattern(mean, left, NO_PIXELS, sensor)
    least = in_time * (2 / freedom) ** 0.5
    return Estimate(in_time, max(scatter, least)), pattern


def slope_of(x: Doubles, estimates: tuple[Estimate, ...]) -> Estimate:
    """Return the slope of a line through estimates, each weighted by its error."""
    values, errors = zip(*((e.value, max(e.error, 1e-12)) for e in estimates), strict=True)
    fit, covariance = np.polyfit(x, values, 1, w=1 / np.array(errors), cov="unscaled")
    return Estimate(float(fit[0]), float(covariance[0, 0] ** 0.5))
