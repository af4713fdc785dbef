"""Dark frames: the black level, column noise, DSNU, hot pixels, and noise without light."""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from clpipe.analysis.calibration import fixed_pattern, repeats
from clpipe.analysis.calibration.fixed_pattern import Pixels
from clpipe.analysis.calibration.line_fit import Estimate, Line
from clpipe.analysis.calibration.repeats import Sensor, Stack
from clpipe.base.types import Floats

CLIPPED = 1e-3  # share of samples at 0 DN from which the frames say nothing of noise


class DarkPattern(NamedTuple):
    """What stays the same in all dark frames."""

    column_noise: Estimate  # DN
    dsnu: Estimate  # DN
    hot: Pixels


@dataclass(frozen=True)
class DarkFrames:
    """The mean of dark frames and its level in DN, hot pixels, and what varies between frames.

    ``stack`` is None for a single frame, or where too many samples are at 0 DN. ``temporal`` is the
    variance of a pixel of one frame, without row noise but with rounding, DN^2; it is 0 where there
    is no stack.
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
        """Analyse dark frames, (frames, height, width) in DN, and add doubts to ``notes``.

        Raises:
            ImageError: two frames are equal sample by sample.
        """
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
            notes.append(
                f"{zeros:.1%} of the dark samples are 0 DN, so the dark frames say nothing of noise"
            )
        elif len(dark) > 1:
            stack = repeats.stacked(dark.copy(), sensor, "dark frames")
            stack.used[hot.rows, hot.columns] = False
            stack.light[...] = stack.around[...] = 0
            rest = stack.rest - stack.rest.mean(axis=2, keepdims=True)
            freedom = stack.used.sum() * stack.degrees * (1 - 1 / mean.shape[1])
            square = float((rest[:, stack.used] ** 2).sum(dtype=np.float64) / freedom)
            temporal = Estimate(square, square * float(np.sqrt(2 / freedom)))
        return DarkFrames(mean, level, len(dark), hot, stack, temporal, sensor)

    def columns(self) -> Floats:
        """The offset of each column, (width,), DN."""
        good = np.ones(self.mean.shape, bool)
        good[self.hot.rows, self.hot.columns] = False
        return np.mean(self.mean - self.level, axis=0, where=good).astype(np.float32)

    def row_noise(self) -> Estimate | None:
        """Row noise in DN; None without a stack."""
        if self.stack is None:
            return None
        flat = Line(Estimate(0.0, 0.0), self.temporal, self.mean.size)
        return repeats.row_variance([repeats.row_offsets(self.stack, flat)[2]]).root()

    def pattern(self, pooled: Line, rounding: float) -> DarkPattern:
        """Column noise, DSNU and hot pixels.

        Args:
            pooled: the noise of all channels, for the temporal noise where there is no stack.
            rounding: the variance of rounding to whole DN, DN^2, which is not part of ``pooled``.
        """
        temporal = self.temporal if self.stack else pooled.lowered(-rounding).floor
        left = temporal.scaled(1 / self.frames)
        column2, dsnu2 = fixed_pattern.dark_pattern(self.mean, left, self.hot, self.sensor)
        return DarkPattern(column2.root(), dsnu2.root(), self.hot)
