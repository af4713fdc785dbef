"""Fixed-pattern noise, the same in every frame: columns, DSNU, PRNU, hot and dead pixels."""

from dataclasses import dataclass

import numpy as np

from clpipe.analysis.calibration.line_fit import Estimate, Line
from clpipe.analysis.calibration.repeats import Sensor, Stack
from clpipe.base.types import Array, Floats, Mask
from clpipe.reference.cfa import sites
from clpipe.reference.image import in_blocks

SURE = 7.0  # standard deviations; by chance, not one of 1e8 pixels exceeds this
# We chose these values; tests/test_calibrate.py shows what they find and reject.
BLOCK = 16  # px of one colour; the side of a block
MIN_BLOCKS = 30  # flat blocks that are needed to measure PRNU
DARKEST = 0.05  # signal units; the lowest mean of a block for measuring PRNU
# Largest standard deviation of the scene in a flat block, relative to its mean.
MAX_UNEVENNESS = 0.03
MIN_DEVIATION = 0.05  # DN; the smallest assumed deviation of a mean dark frame
AROUND = np.array([[1, 1, 1], [1, 0, 1], [1, 1, 1]], bool)  # the neighbours of a pixel


@dataclass(frozen=True)
class Pixels:
    """Hot or dead pixels: their rows and columns, and their excess over their neighbours in DN.

    ``seen_on`` is the share of the sensor on which such a pixel would have been found.
    """

    rows: Array
    columns: Array
    excess: Array
    seen_on: float

    def outside(self, shape: tuple[int, ...]) -> Mask:
        """Return the mask of all other pixels of a plane of this shape."""
        good = np.ones(shape, bool)
        good[self.rows, self.columns] = False
        return good

    def record(self) -> dict[str, object]:
        """Positions as [column, row] and excess in DN, as JSON values."""
        at = np.stack([self.columns, self.rows], axis=1).tolist()
        return {"positions": at, "excess_dn": np.round(self.excess, 2).tolist()}


NO_PIXELS = Pixels(np.zeros(0, int), np.zeros(0, int), np.zeros(0), 1.0)


def _pixels(mask: Array, excess: Array, seen_on: float) -> Pixels:
    """Return the pixels where a mask is True."""
    rows, columns = np.nonzero(mask)
    return Pixels(rows, columns, excess[mask].astype(np.float64), seen_on)


def hot_in_dark(dark: Floats, sensor: Sensor) -> Pixels:
    """Return hot pixels of a mean dark frame, (height, width) in DN.

    They are 7 standard deviations above the median of the 3x3 pixels of the same colour. The
    standard deviation is a quarter of the range from -2 to 2 sigma (95 %) of all pixels.
    """
    from scipy.ndimage import median_filter
    from scipy.stats import norm

    excess = np.empty(dark.shape, np.float32)
    hot = np.empty(dark.shape, bool)
    for site in sites(sensor.pattern).values():
        excess[site] = dark[site] - median_filter(dark[site], 3, mode="mirror")
        low, high = np.quantile(excess[site], norm.cdf([-2, 2]))
        hot[site] = excess[site] > SURE * max((high - low) / 4, MIN_DEVIATION)
    return _pixels(hot, excess, 1.0)


def hot_in_scene(stack: Stack, line: Line) -> Pixels:
    """Return hot pixels of a scene, which exceed all 8 neighbours of the same colour by far.

    The excess must be above 7 standard deviations of the mean plus the range of the neighbours. It
    must also be above three times the excess of any adjacent pixel over its own neighbours.
    """
    from scipy.ndimage import maximum_filter

    low, high = _extremes(stack)
    deviation = np.sqrt(line.at(np.maximum(high, 0)) / len(stack.residuals))
    excess = stack.light - high
    out = np.maximum(np.abs(excess), np.abs(stack.light - low))
    hot = excess > np.maximum(SURE * deviation + (high - low), 0)
    hot &= excess > 3 * maximum_filter(out, footprint=AROUND, mode="mirror")
    return _pixels(stack.used & hot, excess, 1.0)


def dead_in_scene(stack: Stack, line: Line) -> Pixels:
    """Return dead pixels of a scene: dark although all 8 neighbours of the same colour have light.

    A dark pixel has less than 7 standard deviations of dark noise, or less than a tenth of the
    darkest neighbour. The second limit is needed if the line gives dark noise a variance of 0. The
    neighbours must have four times those deviations, and more than their range.
    """
    low, high = _extremes(stack)
    dark = SURE * float(np.sqrt(line.at(np.zeros(1))[0] / len(stack.residuals)))
    lit = low > np.maximum(4 * dark, high - low)
    dead = lit & (stack.light < np.maximum(dark, low / 10))
    return _pixels(dead, stack.light - low, float(lit.mean()))


def _extremes(stack: Stack) -> tuple[Floats, Floats]:
    """Return the smallest and largest light in DN of each pixel's 8 neighbours of one colour."""
    from scipy.ndimage import maximum_filter, minimum_filter

    low, high = np.empty_like(stack.light), np.empty_like(stack.light)
    for site in sites(stack.sensor.pattern).values():
        low[site] = minimum_filter(stack.light[site], footprint=AROUND, mode="mirror")
        high[site] = maximum_filter(stack.light[site], footprint=AROUND, mode="mirror")
    return low, high


def dark_pattern(
    dark: Floats, temporal: Estimate, bad: Pixels, sensor: Sensor
) -> tuple[Estimate, Estimate]:
    """Return the variances of column offsets and of pixels (DSNU) in a mean dark frame, in DN^2.

    Args:
        dark: the mean of the dark frames, DN.
        temporal: the variance that the frames' noise leaves in a pixel of it, without row noise,
            DN^2.
        bad: hot pixels, which are excluded.
        sensor: the sensor; each channel's mean is subtracted, because black levels may differ.

    Returns:
        The variance of columns, without the part from the scatter of pixels, and the variance of
        DSNU, without columns, rows and temporal noise.
    """
    values = dark.astype(np.float64)
    good = bad.outside(dark.shape)
    for site in sites(sensor.pattern).values():
        values[site] -= values[site][good[site]].mean()
    values[~good] = 0
    height, width = dark.shape
    values -= (values.sum(axis=1) / good.sum(axis=1).clip(1))[:, None] * good
    in_column = good.sum(axis=0).clip(1)
    columns = values.sum(axis=0) / in_column
    values -= columns * good
    # The means of rows and columns reduce the degrees of freedom.
    freedom = good.sum() * (1 - 1 / height) * (1 - 1 / width)
    scatter = (values**2).sum() / freedom
    scatter_error = np.sqrt(max((values**4).sum() / freedom - scatter**2, 0) / freedom)
    columns2 = (columns**2).sum() / max(width - 2, 1)  # even and odd columns have their own mean
    left = float((scatter / in_column).mean())
    return (
        Estimate(float(columns2 - left), float(columns2 * np.sqrt(2 / max(width - 2, 1)))),
        Estimate(float(scatter - temporal.value), float(np.hypot(scatter_error, temporal.error))),
    )


def response_pattern(stack: Stack, line: Line, dsnu: float) -> Estimate | None:
    """Return PRNU squared, from flat places of the scene; None if there are too few.

    From blocks of 16x16 pixels of one colour, a smooth surface and the means of rows and columns
    are subtracted. The variance that remains, without temporal noise and DSNU, is (PRNU * light)^2.
    A block is flat if that surface is nearly level and diagonal neighbours are uncorrelated. If
    flat blocks do not agree on the PRNU, it counts as texture of the scene.

    Args:
        stack: the frames of a scene.
        line: their noise, rounding included.
        dsnu: the variance of DSNU in DN^2; 0 if it is unknown.
    """
    surface = _surface()
    freedom = BLOCK**2 - surface.shape[1]
    squares, lights = [], []
    for site in sites(stack.sensor.pattern).values():
        used = _blocks(stack.used[site]).all(axis=(1, 2))
        pixels = _blocks(stack.light[site])[used].reshape(-1, BLOCK**2).astype(np.float64)
        mean = pixels.mean(axis=1)
        shape = pixels @ surface
        uneven = (shape**2).sum(axis=1) - mean**2 * BLOCK**2
        rest = pixels - shape @ surface.T
        square = (rest**2).sum(axis=1) / freedom
        rest = rest.reshape(-1, BLOCK, BLOCK)
        together = np.abs((rest[:, 1:, 1:] * rest[:, :-1, :-1]).mean(axis=(1, 2)))
        flat = (together < 3 / BLOCK * square) & (mean > DARKEST * stack.sensor.unit)
        flat &= uneven < (MAX_UNEVENNESS * mean) ** 2 * BLOCK**2 + square * surface.shape[1]
        squares.append(square[flat])
        lights.append(mean[flat])
    square, light = np.concatenate(squares), np.concatenate(lights)
    if len(light) < MIN_BLOCKS:
        return None
    noise = line.at(light) / len(stack.residuals) + dsnu
    value = 0.0
    for _ in range(5):
        expected = 2 * ((noise + value * light**2) / light**2) ** 2 / freedom
        weight = 1 / expected / (1 / expected).sum()
        value = max(float(weight @ ((square - noise) / light**2)), 0.0)
    apart = (((square - noise) / light**2 - value) ** 2 / expected).mean()
    return Estimate(value, float(np.sqrt(weight**2 @ expected))) if apart < 2 else None


def _surface() -> Array:
    """Return the functions that are subtracted from a block, as orthonormal columns.

    These are the mean of each row and column, and a polynomial surface of the fourth degree:
    (BLOCK^2, functions).
    """
    one = np.linspace(-1, 1, BLOCK)
    row, column = np.repeat(np.eye(BLOCK), BLOCK, axis=0), np.tile(np.eye(BLOCK), (BLOCK, 1))
    mixed = [np.outer(one**i, one**j).ravel() for i in range(1, 4) for j in range(1, 5 - i)]
    basis, sizes, _ = np.linalg.svd(np.column_stack([row, column, *mixed]), full_matrices=False)
    return basis[:, sizes > 1e-9 * sizes[0]]


def _blocks(plane: Array) -> Array:
    """Return a plane cut into whole blocks, (blocks, BLOCK, BLOCK)."""
    return in_blocks(plane, BLOCK).swapaxes(1, 2).reshape(-1, BLOCK, BLOCK)
