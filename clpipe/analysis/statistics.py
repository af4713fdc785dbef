"""All statistics of a channel's noise: by intensity, in space, and its distribution.

Noise is (frame, height, width). ``mask``, (height, width), is True for valid pixels. Standardised
noise is noise divided by its sigma at that intensity. A value that cannot be computed is NaN.
"""

import math
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from clpipe.analysis.intensity import NOT_IN_JSON, NoiseCurve, VarianceLaw, fit_variance
from clpipe.analysis.spatial import LineNoise, autocorrelation, energy_left, line_noise
from clpipe.base.types import Doubles, Floats, Mask

SIGMAS = (2, 3, 4, 5)  # distances from 0; samples farther away are counted
HISTOGRAM = np.linspace(-6.05, 6.05, 122)  # edges of bins; 0 is in the middle of a bin


@dataclass(frozen=True)
class Tails:
    """The distribution of standardised noise; a Gaussian has skewness and excess kurtosis 0."""

    skewness: float
    excess_kurtosis: float
    beyond: tuple[float, ...]  # share of samples whose distance from 0 exceeds each of SIGMAS
    # Counts between HISTOGRAM's edges; the end bins include all farther samples.
    histogram: NDArray[np.int64]


@dataclass(frozen=True)
class Channel:
    """The noise of one channel; sigmas are in the channel's unit."""

    name: str = field(metadata=NOT_IN_JSON)
    samples: int  # in all frames
    sigma: float
    # Sigma of all pixels, including invalid ones.
    sigma_picture: float = field(default=math.nan, kw_only=True)
    law: VarianceLaw | None
    intensity: NoiseCurve
    # Noise by intensity of all pixels.
    intensity_picture: NoiseCurve | None = field(default=None, kw_only=True)
    row: LineNoise
    column: LineNoise
    autocorrelation: Doubles  # (17, 17), down and right from -8 to 8; [8, 8] is 1
    energy_left_2x2: float  # share of the energy that remains after averaging 2x2 pixels
    tails: Tails = field(metadata=NOT_IN_JSON)
    # The number of samples, including invalid ones.
    size: int = field(default=0, kw_only=True, metadata=NOT_IN_JSON)

    @property
    def right(self) -> float:
        """The correlation between the noise of a pixel and of the pixel to the right."""
        middle = len(self.autocorrelation) // 2
        return float(self.autocorrelation[middle, middle + 1])


def tails(standard: Floats, mask: Mask) -> Tails:
    """Return the distribution of standardised noise over valid pixels."""
    values = standard[:, mask].astype(np.float64).ravel()
    ends = float(HISTOGRAM[0]), float(HISTOGRAM[-1])
    histogram = np.histogram(values.clip(*ends), len(HISTOGRAM) - 1, ends)[0]
    if not values.any():
        return Tails(math.nan, math.nan, (math.nan,) * len(SIGMAS), histogram)
    square, size = values * values, np.abs(values)
    beyond = tuple(np.count_nonzero(size > k) / values.size for k in SIGMAS)
    third, fourth = (square * values).mean(), (square * square).mean()
    return Tails(float(third), float(fourth) - 3, beyond, histogram)


def gaussian_beyond(sigmas: float) -> float:
    """Return the share of a Gaussian beyond ``sigmas`` from its mean, on both sides.

    >>> round(gaussian_beyond(2), 4)
    0.0455
    """
    return math.erfc(sigmas / math.sqrt(2))


def correlation(one: Floats, two: Floats, mask: Mask) -> float:
    """Return the correlation of two channels' standardised noise over valid pixels."""
    first, second = one[:, mask].astype(np.float64), two[:, mask].astype(np.float64)
    size = math.sqrt(float((first**2).sum() * (second**2).sum()))
    return float((first * second).sum() / size) if size > 0 else math.nan


def channel_statistics(
    name: str,
    curve: NoiseCurve,
    noise: Floats,
    standard: Floats,
    mask: Mask,
    pairs: Doubles,
    fits_line: bool,
    freedom: float = 1.0,
    whole: Floats | None = None,
) -> Channel:
    """Return all statistics of one channel.

    Args:
        name: the name of the channel.
        curve: its noise by intensity.
        noise: (frame, height, width), without the shift.
        standard: standardised noise, (frame, height, width).
        mask: the valid pixels, (height, width); at least one.
        pairs: :func:`clpipe.analysis.spatial.count_pairs` of the mask.
        fits_line: whether to fit a line, because the variance is linear in the intensity.
        freedom: the degrees of freedom of a sample, below 1 if the truth is a mean of frames.
        whole: the noise of all pixels, including invalid ones.
    """
    table = autocorrelation(standard, pairs)
    # Correlated samples count as fewer independent ones: their number is divided by the sum of the
    # squared correlations (Bartlett 1946).
    independent = freedom / float(np.nansum(table**2)) if np.isfinite(table).any() else freedom
    samples = noise[:, mask].astype(np.float64)
    rows, columns = line_noise(noise, mask), line_noise(noise.swapaxes(1, 2), mask.T)
    law = fit_variance(curve, min(independent, freedom)) if fits_line else None
    if law:
        # b includes the variance of the offsets of rows and columns. Each has one offset, so
        # the error of that variance follows from their number.
        frames, height, width = noise.shape
        in_rows, in_columns = rows.sigma**2 * (2 / (frames * height)) ** 0.5, 0.0
        if columns.sigma > columns.limit:
            in_columns = columns.sigma**2 * (2 / width) ** 0.5
        line_errors = [x for x in (in_rows, in_columns) if np.isfinite(x)]
        law = replace(law, b_error=float(np.hypot.reduce([law.b_error, *line_errors])))
    return Channel(
        name=name,
        samples=samples.size,
        sigma=float(np.sqrt((samples**2).mean())),
        intensity=curve,
        law=law,
        row=rows,
        column=columns,
        autocorrelation=table,
        energy_left_2x2=energy_left(standard, mask),
        tails=tails(standard, mask),
        sigma_picture=math.nan if whole is None else float(whole.std(dtype=np.float64)),
        size=0 if whole is None else whole.size,
    )
