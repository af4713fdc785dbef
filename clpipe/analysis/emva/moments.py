"""Means and variances of a series' frames in DN, from which all figures are computed."""

from dataclasses import dataclass

import numpy as np

from clpipe.analysis.calibration.line_fit import Estimate
from clpipe.analysis.emva.series import Exposure, Series
from clpipe.base.types import Array, Doubles


@dataclass(frozen=True)
class Temporal:
    """Statistics of pairs of frames: arrays with a value for each exposure, in DN and DN^2."""

    time: Doubles  # ns
    photons: Doubles
    mean: Doubles
    variance: Doubles  # temporal variance of a frame
    flicker: Doubles  # the difference between the means of the two frames


@dataclass(frozen=True)
class Spatial:
    """Statistics of a stack of frames.

    ``variance`` is the spatial variance of the sensor (s^2), without the part that temporal noise
    leaves in a mean of frames. Its parts are those of rows, columns and pixels. ``temporal`` is the
    variance of a frame. Variances are in DN^2.
    """

    frames: int
    mean_frame: Doubles  # (height, width), DN
    temporal: float
    at_zero: float = 0.0  # share of samples that are 0 DN

    @property
    def mean(self) -> float:
        """The mean of all pixels in DN."""
        return float(self.mean_frame.mean())

    @property
    def residue(self) -> float:
        """The variance that temporal noise has in the mean frame."""
        return self.temporal / self.frames

    @property
    def variance(self) -> Estimate:
        """s^2 = s_measured^2 - sigma^2 / L."""
        measured = float(self.mean_frame.var(ddof=1))
        return _less(measured, self.residue, self.mean_frame.size)

    @property
    def parts(self) -> tuple[Estimate, Estimate, Estimate]:
        """The parts of rows, columns and pixels, which add up to the variance.

        For N columns and M rows, means of rows have the variance row + pixel / N, and those of
        columns have column + pixel / M (release 4.0). Negative values are set to zero.
        """
        rows, columns = self.mean_frame.shape
        total = self.variance
        of_rows = _less(self.mean_frame.mean(axis=1).var(), self.residue / columns, rows)
        of_columns = _less(self.mean_frame.mean(axis=0).var(), self.residue / rows, columns)
        rest = total.value - of_rows.value - of_columns.value
        pixel = rest / (1 - 1 / rows - 1 / columns)
        return (
            Estimate(of_rows.value - pixel / columns, of_rows.error),
            Estimate(of_columns.value - pixel / rows, of_columns.error),
            Estimate(pixel, total.error),
        )

    @property
    def stripes(self) -> Estimate:
        """The variance in DN^2 of column offsets that differ between neighbours.

        It is half the variance of differences of neighbouring columns, minus the part that single
        pixels leave in means of columns. Slopes over many columns do not affect it.
        """
        steps = np.diff(self.mean_frame, axis=1)
        rows, count = steps.shape
        of_pixels = float(steps.var(axis=0, ddof=1).mean()) / 2 / rows
        # Each column is in two differences, which makes 1.5 times the variance of a mean.
        return _less(np.square(steps.mean(axis=0)).mean() / 2, of_pixels, count / 1.5)


def _less(measured: float, noise: float, count: float) -> Estimate:
    """Return a variance of ``count`` values, minus the variance of their noise.

    The standard error is that of the noise only: of repeated measurements of the same sensor.
    """
    variance = float(measured) - noise
    scatter = 4 * max(variance, 0.0) * noise + 2 * noise * noise
    return Estimate(variance, float(np.sqrt(scatter / count)))


@dataclass(frozen=True)
class Moments:
    """The statistics of a series: pairs with and without light, and the two stacks.

    ``dark_of`` lists, for each pair with light, the number of the dark pair of the same time.
    """

    full_scale: int
    white: int  # the largest DN of a frame
    bright: Temporal
    dark: Temporal
    dark_of: Array
    bright_stack: Spatial
    dark_stack: Spatial
    time: float  # exposure time of the stacks, ns

    @property
    def light(self) -> Doubles:
        """The means of pairs with light minus dark, in DN."""
        return self.bright.mean - self.dark.mean[self.dark_of]

    @property
    def noise(self) -> Doubles:
        """The variances of pairs with light minus dark, in DN^2."""
        return self.bright.variance - self.dark.variance[self.dark_of]


def read_moments(series: Series) -> Moments:
    """Read all frames of a series, one or two of them at a time.

    Raises:
        RequestError: a frame cannot be read, or does not match the series.
    """
    white = 0

    def pair(exposure: Exposure) -> tuple[float, ...]:
        nonlocal white
        one, two = (series.read(frame) for frame in exposure.frames)
        white = max(white, int(one.max()), int(two.max()))
        flicker = float(one.mean() - two.mean())
        # A frame has half the variance of the difference.
        square = float(np.square(one.astype(np.float64) - two).mean())
        mean = float(one.mean() + two.mean()) / 2
        return exposure.time, exposure.photons, mean, (square - flicker**2) / 2, flicker

    def pairs(exposures: tuple[Exposure, ...]) -> Temporal:
        return Temporal(*np.array([pair(each) for each in exposures], np.float64).T)

    bright, dark = pairs(series.bright), pairs(series.dark)
    return Moments(
        full_scale=series.full_scale,
        white=white,
        bright=bright,
        dark=dark,
        dark_of=np.array([series.dark_of(each) for each in series.bright]),
        bright_stack=_stack(series, series.bright_stack),
        dark_stack=_stack(series, series.dark_stack),
        time=series.bright_stack.time,
    )


def _stack(series: Series, exposure: Exposure) -> Spatial:
    """Return the mean frame and the temporal variance of a stack."""
    total = np.zeros((series.height, series.width), np.int64)
    squares = np.zeros_like(total)
    at_zero = 0.0
    for frame in exposure.frames:
        pixels = series.read(frame).astype(np.int64)
        total += pixels
        squares += pixels * pixels
        at_zero += np.count_nonzero(pixels == 0) / pixels.size
    count = len(exposure.frames)
    temporal = (squares.mean() - np.square(total).mean() / count) / (count - 1)
    return Spatial(count, total / count, float(temporal), at_zero / count)
