"""The line variance = gain*light + floor through the pixels of repeated frames.

What a pixel's frames say of its light is noisy itself, and a plain least-squares line through noisy
abscissas is too flat. So the line is found with an instrument (Fuller, Measurement Error Models,
1987, sec. 1.4): the mean of neighbours of the same colour, which follows the light but shares no
noise with the pixel. Only sums by classes of the instrument are kept, so a line costs nothing.
"""

from collections.abc import Sequence
from dataclasses import asdict, dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from clpipe.base.types import Array

CLASSES = 2048
GROUPS = 64  # of rows
BINS = 32  # for pictures
LEAST_IN_BIN = 50
DARKEST = 0.01  # of the pixels
ROUNDS = 12  # of weights from the line before


@dataclass(frozen=True)
class Estimate:
    """A figure and its standard error."""

    value: float
    error: float

    @property
    def seen(self) -> bool:
        """Whether it is above zero by more than two standard errors."""
        return self.value > 2 * self.error

    def scaled(self, factor: float) -> "Estimate":
        """The same in another unit."""
        return Estimate(self.value * factor, self.error * abs(factor))

    def root(self) -> "Estimate":
        """The standard deviation of a variance; of one that is not above zero, 0 with the deviation
        that a variance of one standard error would have.

        >>> Estimate(4.0, 0.4).root(), Estimate(-1.0, 0.25).root()
        (Estimate(value=2.0, error=0.1), Estimate(value=0.0, error=0.5))
        """
        if self.value <= 0:
            return Estimate(0.0, float(np.sqrt(self.error)))
        root = float(np.sqrt(self.value))
        return Estimate(root, self.error / (2 * root))


@dataclass(frozen=True)
class Line:
    """variance = gain*light + floor: the gain in DN (or DN/e-), the floor in DN^2."""

    gain: Estimate
    floor: Estimate
    pixels: int

    def at(self, light: Array) -> Array:
        """The variance at light above black in DN; never less than a ten-thousandth of the gain's
        share at the white end, so that it can be divided by.
        """
        variance = self.gain.value * light + self.floor.value
        return np.maximum(variance, 1e-4 * max(np.max(variance), 1e-9))

    def lowered(self, variance: float) -> "Line":
        """The same less a variance that is known."""
        floor = Estimate(self.floor.value - variance, self.floor.error)
        return Line(self.gain, floor, self.pixels)

    def record(self, signal_range: float) -> dict[str, Any]:
        """a and b in signal units, gain and read noise in DN, each with its standard error."""
        return {
            "a": asdict(self.gain.scaled(1 / signal_range)),
            "b": asdict(self.floor.scaled(1 / signal_range**2)),
            "system_gain": asdict(self.gain),
            "read_noise": asdict(self.floor.root()),
            "pixels": self.pixels,
        }


@dataclass(frozen=True)
class Table:
    """Sums over pixels by classes of the instrument, in groups of rows.

    ``sums`` is (GROUPS, 4, CLASSES): count, instrument, light and variance; ``squares`` (CLASSES,)
    has the variance squared. ``degrees`` of freedom are those of each pixel's variance.
    """

    sums: NDArray[np.float64] = field(repr=False)
    squares: NDArray[np.float64] = field(repr=False)
    degrees: int

    @staticmethod
    def of(
        variance: Array, light: Array, instrument: Array, rows: Array, unit: float, degrees: int
    ) -> "Table":
        """The table of some pixels, all arrays alike.

        Args:
            variance: of each pixel over the frames, DN^2, unbiased.
            light: mean of each pixel above black, DN.
            instrument: what follows the light without sharing the pixel's noise, DN.
            rows: of each pixel; pixels of one row may share noise.
            unit: white level above black, DN.
            degrees: frames less one.
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
    """The class of each value: as wide as the root of the signal, so narrow in the dark.

    >>> class_of(np.array([-3.0, 0.0, 250.0, 9e9]), 1000).tolist()
    [0, 0, 975, 2045]
    """
    root = np.sqrt(np.clip(instrument / unit, 0, 1.1))
    return np.minimum(root * (CLASSES / 1.05), CLASSES - 1).astype(np.intp)


def fit_line(tables: Sequence[Table]) -> Line:
    """The line through tables, and its standard errors.

    Weighted by the inverse variance of a sample variance, degrees/(2 variance^2), with the variance
    from the line itself. Errors by the sandwich formula over groups of rows (Liang and Zeger,
    Biometrika 1986), so they hold for noise that is not Gaussian, and for what rows share.

    >>> light, rows = np.linspace(0, 900, 1001), np.arange(1001)
    >>> line = fit_line([Table.of(0.5 * light + 4, light, light, rows, 1000, 7)])
    >>> round(line.gain.value, 6), round(line.floor.value, 6)
    (0.5, 4.0)

    Raises:
        ValueError: no line is defined: fewer than three pixels, or all alike in light.
    """
    groups = np.concatenate([t.sums for t in tables], axis=2)
    degrees = np.repeat([float(t.degrees) for t in tables], CLASSES)
    used = groups[:, 0].sum(axis=0) > 0
    groups, degrees = groups[..., used], degrees[used]
    count, z, m, s = groups.sum(axis=0)
    z = z / count
    total = count.sum()
    if total < 3 or np.ptp(z) == 0:
        raise ValueError("too few pixels count, or all have the same light")
    # Weights start from a rising line through the darkest pixels and all; they never take a
    # variance for less than half of the darkest pixels', or few of these could run away with all.
    order = np.argsort(z)
    darkest = order[np.cumsum(count[order]) <= max(DARKEST * total, count[order[0]], LEAST_IN_BIN)]
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
    """Pixels of about the same light: mean light and mean variance, in DN and DN^2."""

    light: float
    variance: float
    error: float
    pixels: int


def binned(table: Table) -> tuple[Bin, ...]:
    """A table in few bins of equal width in the root of the light, those with enough pixels."""
    sums = np.vstack([table.sums.sum(axis=0), table.squares]).reshape(5, BINS, -1).sum(axis=-1)
    found = []
    for count, _, light, variance, square in sums.T:
        if count >= LEAST_IN_BIN:
            scatter = max(square / count - (variance / count) ** 2, 0.0)
            error = float(np.sqrt(scatter / count))
            found.append(Bin(float(light / count), float(variance / count), error, int(count)))
    return tuple(found)
