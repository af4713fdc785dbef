"""The line variance = gain*light + floor through the pixels of repeated frames.

A pixel's mean over the frames is itself noisy, and an ordinary least-squares line through noisy
abscissas is too flat. The line is therefore fitted with an instrumental variable (Fuller,
Measurement Error Models, 1987, sec. 1.4). This is the mean of neighbours of the same colour, which
follows the light but shares no noise with the pixel. A fit is fast, because only sums by classes of
the instrument are stored.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from clpipe.analysis.report import json_object
from clpipe.base.types import Array

CLASSES = 2048  # classes of the instrument, the variable that sorts pixels
GROUPS = 64  # groups of rows, for the standard errors
BINS = 32  # bins of the curves in plots
MIN_IN_BIN = 50  # pixels that a bin needs
DARKEST = 0.01  # share of pixels; the first weights are computed from the darkest ones
ROUNDS = 12  # rounds; each computes weights from the line of the previous round


@dataclass(frozen=True)
class Estimate:
    """A figure and its standard error."""

    value: float
    error: float

    @property
    def significant(self) -> bool:
        """Whether the value is above zero by more than two standard errors."""
        return self.value > 2 * self.error

    def scaled(self, factor: float) -> "Estimate":
        """Return value and error times a factor, for example to convert the unit."""
        return Estimate(self.value * factor, self.error * abs(factor))

    def over(self, below: "Estimate") -> "Estimate":
        """Return the quotient of two estimates whose errors are independent."""
        value = self.value / below.value
        error = np.hypot(self.error, value * below.error) / below.value
        return Estimate(value, float(error))

    def root(self) -> "Estimate":
        """Return the standard deviation, if this is a variance.

        If the variance is not above zero, the value is 0, and the error is the root of the standard
        error.

        >>> Estimate(4.0, 0.4).root(), Estimate(-1.0, 0.25).root()
        (Estimate(value=2.0, error=0.1), Estimate(value=0.0, error=0.5))
        """
        if self.value <= 0:
            return Estimate(0.0, float(np.sqrt(self.error)))
        root = float(np.sqrt(self.value))
        return Estimate(root, self.error / (2 * root))


def weighted(estimates: Sequence[Estimate]) -> Estimate:
    """Return the mean of estimates, weighted by their inverse squared errors."""
    weight = np.array([max(e.error, 1e-150) ** -2.0 for e in estimates])
    value = np.average([e.value for e in estimates], weights=weight)
    return Estimate(float(value), float(weight.sum() ** -0.5))


@dataclass(frozen=True)
class Line:
    """The line variance = gain*light + floor, with the gain in DN/e- and the floor in DN^2.

    ``pixels`` is the number of pixels that it was fitted to.
    """

    gain: Estimate
    floor: Estimate
    pixels: int

    def at(self, light: Array) -> Array:
        """Return the variance at each light above black in DN.

        Each is at least a ten-thousandth of the largest, so that dividing by it is safe.
        """
        variance = self.gain.value * light + self.floor.value
        return np.maximum(variance, 1e-4 * max(np.max(variance), 1e-9))

    def lowered(self, variance: float) -> "Line":
        """Return the line with ``variance``, DN^2, subtracted from its floor."""
        floor = Estimate(self.floor.value - variance, self.floor.error)
        return Line(self.gain, floor, self.pixels)

    def record(self, signal_range: float) -> dict[str, Any]:
        """Return a and b in signal units, gain and read noise in DN, each with its error."""
        return json_object(
            a=self.gain.scaled(1 / signal_range),
            b=self.floor.scaled(1 / signal_range**2),
            system_gain=self.gain,
            read_noise=self.floor.root(),
            pixels=self.pixels,
        )


@dataclass(frozen=True)
class Table:
    """Sums over pixels by classes of the instrument, in groups of rows.

    ``sums`` is (GROUPS, 4, CLASSES): count, instrument, light and variance. ``squares`` contains
    squared variances, (CLASSES,). ``degrees`` are the degrees of freedom of a pixel's variance.
    """

    sums: NDArray[np.float64] = field(repr=False)
    squares: NDArray[np.float64] = field(repr=False)
    degrees: int

    @staticmethod
    def of(
        variance: Array, light: Array, instrument: Array, rows: Array, unit: float, degrees: int
    ) -> "Table":
        """Return the table of some pixels; all arrays have one value for each pixel.

        Args:
            variance: the unbiased variance over the frames, DN^2.
            light: the mean over the frames above black, DN.
            instrument: a value that follows the light but shares no noise with the pixel, DN.
            rows: the number of the row, because pixels of one row may share noise.
            unit: the white level minus the black level, DN.
            degrees: the number of frames minus one.
        """
        place = class_of(instrument, unit)
        grouped = place + CLASSES * (rows % GROUPS)
        sums = [
            np.bincount(grouped, weights, GROUPS * CLASSES)
            for weights in (None, instrument, light, variance)
        ]
        sums_by_group = np.array(sums, np.float64).reshape(4, GROUPS, CLASSES).swapaxes(0, 1)
        squares = np.bincount(place, np.square(variance, dtype=np.float64), CLASSES)
        return Table(sums_by_group, squares.astype(np.float64), degrees)


def class_of(instrument: Array, unit: float) -> NDArray[np.intp]:
    """Return the class of each value. Classes have equal width in the root of the signal.

    >>> class_of(np.array([-3.0, 0.0, 250.0, 9e9]), 1000).tolist()
    [0, 0, 975, 2045]
    """
    root = np.sqrt(np.clip(instrument / unit, 0, 1.1))
    return np.minimum(root * (CLASSES / 1.05), CLASSES - 1).astype(np.intp)


def fit_line(tables: Sequence[Table]) -> Line:
    """Fit the line through tables, with its standard errors.

    A pixel's weight is the inverse variance of its sample variance, degrees / (2 variance^2), with
    the variance from the line itself. The errors come from the sandwich formula over groups of rows
    (Liang and Zeger, Biometrika 1986). They are therefore valid for row noise, and for noise that
    is not Gaussian.

    >>> light, rows = np.linspace(0, 900, 1001), np.arange(1001)
    >>> line = fit_line([Table.of(0.5 * light + 4, light, light, rows, 1000, 7)])
    >>> round(line.gain.value, 6), round(line.floor.value, 6)
    (0.5, 4.0)

    Raises:
        ValueError: there are fewer than three pixels, or all have the same light.
    """
    groups = np.concatenate([t.sums for t in tables], axis=2)
    degrees = np.repeat([float(t.degrees) for t in tables], CLASSES)
    used = groups[:, 0].sum(axis=0) > 0
    groups, degrees = groups[..., used], degrees[used]
    count, z, m, s = groups.sum(axis=0)
    z = z / count
    total = count.sum()
    if total < 3 or np.ptp(z) == 0:
        raise ValueError(
            "too few pixels can be used, or all have the same brightness; use a scene with "
            "dark and bright areas"
        )
    # The first weights are those of a rising line through the darkest pixels and the mean of all.
    # Variances are at least half of the darkest pixels' variance, so that no weight grows without
    # limit.
    order = np.argsort(z)
    darkest = order[np.cumsum(count[order]) <= max(DARKEST * total, count[order[0]], MIN_IN_BIN)]
    dark = s[darkest].sum() / count[darkest].sum()
    slope = max(s.sum() / total - dark, 0.0) / max((z @ count) / total - z.min(), 1e-9)
    least = max(0.5 * dark, 1e-9)
    variance = np.maximum(dark + slope * (z - z.min()), least)
    instruments = np.stack([z, np.ones_like(z)])
    for _ in range(ROUNDS):
        weighted = instruments * degrees / variance**2
        matrix = np.stack([weighted @ m, weighted @ count], axis=1)
        gain, floor = np.linalg.solve(matrix, weighted @ s)
        variance = np.maximum(gain * z + floor, least)
    scores = (groups[:, 3] - gain * groups[:, 2] - floor * groups[:, 0]) @ weighted.T
    filled = np.count_nonzero(groups[:, 0].any(axis=1))
    inverse = np.linalg.inv(matrix)
    covariance = inverse @ scores.T @ scores @ inverse.T * filled / max(filled - 2, 1)
    errors = np.sqrt(np.diag(covariance))
    return Line(
        Estimate(float(gain), float(errors[0])),
        Estimate(float(floor), float(errors[1])),
        int(total),
    )


@dataclass(frozen=True)
class Bin:
    """Pixels of similar light: mean light in DN, mean variance and its standard error in DN^2."""

    light: float
    variance: float
    error: float
    pixels: int


def binned(table: Table) -> tuple[Bin, ...]:
    """Return a table in 32 bins of equal width in the root of the light, without sparse bins."""
    sums = np.vstack([table.sums.sum(axis=0), table.squares]).reshape(5, BINS, -1).sum(axis=-1)
    bins = []
    for count, _, light, variance, square in sums.T:
        if count >= MIN_IN_BIN:
            scatter = max(square / count - (variance / count) ** 2, 0.0)
            error = float(np.sqrt(scatter / count))
            bins.append(Bin(float(light / count), float(variance / count), error, int(count)))
    return tuple(bins)
