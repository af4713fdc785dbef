"""Noise in space: autocorrelation, row and column noise, and noise after averaging 2x2 pixels.

Functions take noise, (frame, height, width), and ``mask``, (height, width), which is True for valid
pixels. A value that cannot be computed is NaN.
"""

import itertools
import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from clpipe.base.types import Doubles, Floats, Mask

LAGS = 8  # px; the largest lag


@dataclass(frozen=True)
class LineNoise:
    """The sigma of the offsets of rows (or columns), and the limit that chance can reach."""

    sigma: float
    limit: float


def lag_sums(planes: NDArray[np.floating[Any]], lags: int = LAGS) -> Doubles:
    """Return the sums of products of pixel pairs at lags of -8 to 8 down and right, (17, 17).

    They are computed from the power spectrum (Wiener-Khinchin), with a margin of zeros that
    prevents wrapping, and in the precision of the planes.

    Args:
        planes: (frame, height, width).
        lags: the largest lag, px.
    """
    height, width = (fast_size(size + lags) for size in planes.shape[1:])
    power = np.zeros((height, width // 2 + 1), planes.dtype)
    for plane in planes:
        waves = np.fft.rfft2(plane, (height, width))
        power += waves.real**2 + waves.imag**2
    steps = np.arange(-lags, lags + 1)
    rows = np.fft.ifft(power, axis=0)[steps]
    return np.asarray(np.fft.irfft(rows, width)[:, steps], np.float64)


def fast_size(size: int) -> int:
    """Return the next size of a fast Fourier transform, without prime factors above 5.

    >>> fast_size(518)
    540
    """
    return next(n for n in itertools.count(size) if 60**20 % n == 0)


def count_pairs(mask: Mask, lags: int = LAGS) -> Doubles:
    """Return the number of pairs of valid pixels at each lag, (17, 17)."""
    return np.rint(lag_sums(mask[None].astype(np.float64), lags))


def autocorrelation(planes: NDArray[np.floating[Any]], pairs: Doubles) -> Doubles:
    """Return the autocorrelation of noise over all frames, like ``pairs``: (17, 17).

    Lag 0 is in the middle. Values are NaN at lags without pairs, and everywhere without noise.

    Args:
        planes: (frame, height, width), 0 for invalid pixels.
        pairs: :func:`count_pairs` of the mask.

    >>> plane = np.random.default_rng(0).normal(size=(1, 200, 200)).astype(np.float32)
    >>> table = autocorrelation(plane, count_pairs(np.ones((200, 200), bool)))
    >>> round(float(table[8, 8]), 6), bool(abs(table[8, 9]) < 0.03)
    (1.0, True)
    """
    lags = len(pairs) // 2
    with np.errstate(invalid="ignore", divide="ignore"):
        covariance = np.where(pairs > 0, lag_sums(planes, lags) / pairs, np.nan)
        variance = covariance[lags, lags]
        return np.asarray(covariance / (variance if variance > 0 else np.nan))


def spectrum_of(table: Doubles) -> tuple[Doubles, Doubles]:
    """Return the power spectrum of an autocorrelation, and the frequencies, (64, 64) each.

    It is the transform of the autocorrelation with a triangular window (Blackman and Tukey, 1958;
    the window is Bartlett's). Independent noise has 1 everywhere. Frequencies are in cycles per
    pixel.
    """
    lags = len(table) // 2
    steps, frequency = np.arange(-lags, lags + 1), np.fft.fftfreq(64)
    fall = 1 - np.abs(steps) / (lags + 1)
    waves = np.exp(-2j * np.pi * np.outer(frequency, steps))
    spectrum = (waves @ (np.nan_to_num(table) * np.outer(fall, fall)) @ waves.T).real
    return spectrum, np.hypot(frequency[:, None], frequency[None])


def radial_spectrum(table: Doubles, most: float, rings: int) -> tuple[Doubles, Doubles]:
    """Return the mean power of an autocorrelation in rings of frequency, see :func:`spectrum_of`.

    Args:
        table: the autocorrelation.
        most: the highest frequency, cycles/px.
        rings: the number of rings.

    Returns:
        The frequencies in the middle of the rings, and the power: 1 for independent noise.
    """
    spectrum, radius = spectrum_of(table)
    edges = np.linspace(0, most, rings + 1)
    number = np.digitize(radius, edges)
    power = [spectrum[number == k].mean() for k in range(1, len(edges))]
    return (edges[1:] + edges[:-1]) / 2, np.array(power)


def line_noise(noise: Floats, mask: Mask) -> LineNoise:
    """Return the sigma of the offset that all pixels of a row share; transpose for columns.

    The variance of the offsets is the mean product of the noise in two pixels of a row. The
    variance of row means would include the noise of pixels. Pairs at most 8 px apart are excluded,
    because processing may have correlated them. The limit is the root of three standard errors of
    the variance.
    """

    def far_pairs(plane: NDArray[np.floating[Any]]) -> Doubles:
        total = plane.sum(-1, dtype=np.float64) ** 2 - (plane * plane).sum(-1, dtype=np.float64)
        for lag in range(1, min(LAGS, plane.shape[-1] - 1) + 1):
            near = (plane[..., lag:] * plane[..., :-lag]).sum(-1, dtype=np.float64)
            total -= 2 * near
        return total

    products = far_pairs(noise).ravel()
    pairs = np.tile(np.rint(far_pairs(mask.astype(np.float64))), len(noise))
    if pairs.sum() <= 0:
        return LineNoise(math.nan, math.nan)
    variance = products.sum() / pairs.sum()
    error = np.sqrt(((products - variance * pairs) ** 2).sum()) / pairs.sum()
    return LineNoise(math.sqrt(max(float(variance), 0.0)), math.sqrt(3 * float(error)))


def energy_left(standard: NDArray[np.floating[Any]], mask: Mask) -> float:
    """Return the share of the noise's energy that remains after averaging 2x2 pixels.

    It is a quarter for independent noise and more for noise that processing has correlated (Bielova
    et al., CVPR Workshops 2019). Blocks with an invalid pixel are excluded.
    """
    height, width = (size // 2 * 2 for size in mask.shape)
    whole = mask[:height, :width].reshape(height // 2, 2, width // 2, 2).all((1, 3))
    corners = [
        standard[:, i:height:2, j:width:2][:, whole].astype(np.float64)
        for i, j in ((0, 0), (0, 1), (1, 0), (1, 1))
    ]
    energy = sum(float((corner**2).sum()) for corner in corners)
    together = float((np.add.reduce(corners) ** 2).sum()) / 4
    return together / energy if energy > 0 else math.nan
