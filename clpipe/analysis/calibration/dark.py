"""Dark frames: the black level, column noise, DSNU, hot pixels, and noise without light."""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from clpipe.analysis.calibration import fixed_pattern, repeats
from clpipe.analysis.calibration.fixed_pattern import Pixels
from clpipe.analysis.calibration.line_fit import Estimate, Line
from clpipe.analysis.calibration.repeats import Sensor, Stack
from clpipe.base.types import Floats

CLIPPED = 1e-3  # noise cannot be measured if more than this share of samples is at 0 DN


class DarkPattern(NamedTuple):
    """The noise that all dark frames share."""

    column_noise: Estimate  # DN
    dsnu: Estimate  # DN
    hot: Pixels


@dataclass(frozen=True)
class DarkFrames:
    """The mean of dark frames and its level in DN, hot pixels, and the variation between frames.

    The stack is None for a single frame, or if too many samples are 0 DN. The temporal variance is
    that of a pixel of one frame in DN^2, without row noise but with rounding. It is 0 if there is
    no stack.
    """

    mean: Floats
    level: float
    frames: int
    hot: Pixels
    stack: Stack | None
    temporal: Estimate
    sensor: Sensor

    @staticmethod
    def analyse(dark: Floats | None, sensor: Sensor, notes: list[str]) -> "DarkFrames | None":
        """Analyse dark frames, (frames, height, width) in DN, and add remarks to ``notes``.

        Raises:
            ImageError: two frames have equal samples.
        """
        if dark is None:
            return None
        mean = dark.mean(axis=0, dtype=np.float64)
        hot = fixed_pattern.hot_in_dark(mean, sensor)
        good = hot.outside(mean.shape)
        level = float(mean[good].mean())
        if abs(level - sensor.black_level) > max(1.0, 0.1 * float(dark[0].std())):
            notes.append(
                f"the mean of dark frames is {level:.2f} DN, not the black level of "
                f"{sensor.black_level:g}; light is counted from that mean"
            )
        zeros = float((dark <= 0).mean())
        stack, temporal = None, Estimate(0.0, 0.0)
        if zeros > CLIPPED:
            notes.append(
                f"{zeros:.1%} of the dark samples are 0 DN, so noise cannot be measured in them"
            )
        elif len(dark) > 1:
            stack = repeats.stack_frames(dark.copy(), sensor, "dark frames")
            stack.used[hot.rows, hot.columns] = False
            stack.light[...] = stack.neighbour_mean[...] = 0
            rest = stack.residuals - stack.residuals.mean(axis=2, keepdims=True)
            freedom = stack.used.sum() * stack.degrees * (1 - 1 / mean.shape[1])
            square = float((rest[:, stack.used] ** 2).sum(dtype=np.float64) / freedom)
            temporal = Estimate(square, square * float(np.sqrt(2 / freedom)))
        return DarkFrames(mean, level, len(dark), hot, stack, temporal, sensor)

    def columns(self) -> Floats:
        """Return the offset of each column in DN, (width,)."""
        good = self.hot.outside(self.mean.shape)
        return np.mean(self.mean - self.level, axis=0, where=good).astype(np.float32)

    def row_noise(self) -> Estimate | None:
        """Return row noise in DN; None without a stack."""
        if self.stack is None:
            return None
        flat = Line(Estimate(0.0, 0.0), self.temporal, self.mean.size)
        return repeats.row_variance([repeats.row_offsets(self.stack, flat)[2]]).root()

    def pattern(self, pooled: Line, rounding: float) -> DarkPattern:
        """Return column noise, DSNU and hot pixels.

        Args:
            pooled: the noise of all channels, for the temporal noise if there is no stack.
            rounding: the variance of rounding to whole DN, DN^2, which ``pooled`` excludes.
        """
        temporal = self.temporal if self.stack else pooled.lowered(-rounding).floor
        left = temporal.scaled(1 / self.frames)
        column2, dsnu2 = fixed_pattern.dark_pattern(self.mean, left, self.hot, self.sensor)
        return DarkPattern(column2.root(), dsnu2.root(), self.hot)
