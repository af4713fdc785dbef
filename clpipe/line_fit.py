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

from clpipe.types import Array

CLASSES = 2048
BINS = 32  # for pictures
LEAST_IN_BIN = 50
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
    """Sums over pixels by classes of the instrument, (7, CLASSES): count, instrument z, light m,
    m^2, variance s, s*m, s^2. ``degrees`` of freedom are those of each pixel's variance.
    """

    sums: NDArray[np.float64] = field(repr=False)
    degrees: int

    @staticmethod
    def of(variance: Array, light: Array, instrument: Array, unit: float, degrees: int) -> "Table":
        """The table of some pixels, all arrays alike.

        Args:
            variance: of each pixel over the frames, DN^2, unbiased.
            light: mean of each pixel above black, DN.
            instrument: what follows the light without sharing the pixel's noise, DN.
            unit: white level above black, DN.
            degrees: frames less one.
        """
        s, m, z = (x.ravel().astype(np.float64) for x in (variance, light, instrument))
        place = class_of(z, unit)
        columns = (None, z, m, m * m, s, s * m, s * s)
        sums = [np.bincount(place, weights=c, minlength=CLASSES) for c in columns]
        return Table(np.array(sums, np.float64), degrees)


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
    from the line itself. Errors by the sandwich formula (White, Econometrica 1980), so they hold
    for noise that is not Gaussian too.

    >>> light = np.linspace(0, 900, 1001)
    >>> line = fit_line([Table.of(0.5 * light + 4, light, light, 1000, 7)])
    >>> round(line.gain.value, 6), round(line.floor.value, 6)
    (0.5, 4.0)

    Raises:
        ValueError: no line is defined: fewer than three pixels, or all alike in light.
    """
    count, z, m, m2, s, sm, s2 = np.concatenate([t.sums for t in tables], axis=1)
    degrees = np.repeat([float(t.degrees) for t in tables], CLASSES)
    used = count > 0
    count, z, m, m2, s, sm, s2, degrees = (x[used] for x in (count, z, m, m2, s, sm, s2, degrees))
    z = z / count
    if count.sum() < 3 or np.ptp(z) == 0:
        raise ValueError("all pixels have the same light")
    instruments = np.stack([z, np.ones_like(z)])
    least = 1e-4 * s.sum() / count.sum()
    variance = np.maximum(s / count, least)
    for _ in range(ROUNDS):
        weighted = instruments * degrees / variance**2
        matrix = np.stack([weighted @ m, weighted @ count], axis=1)
        gain, floor = np.linalg.solve(matrix, weighted @ s)
        variance = np.maximum(gain * z + floor, least)
    residual2 = s2 - 2 * gain * sm - 2 * floor * s
    residual2 += gain**2 * m2 + 2 * gain * floor * m + floor**2 * count
    meat = (weighted * np.maximum(residual2, 0)) @ weighted.T
    inverse = np.linalg.inv(matrix)
    errors = np.sqrt(np.diag(inverse @ meat @ inverse.T))
    return Line(
        Estimate(float(gain), float(errors[0])),
        Estimate(float(floor), float(errors[1])),
        int(count.sum()),
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
    found = []
    for count, _, m, _, s, _, s2 in table.sums.reshape(7, BINS, -1).sum(axis=-1).T:
        if count >= LEAST_IN_BIN:
            scatter = max(s2 / count - (s / count) ** 2, 0.0)
            error = float(np.sqrt(scatter / count))
            found.append(Bin(float(m / count), float(s / count), error, int(count)))
    return tuple(found)
