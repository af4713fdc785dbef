"""Figures of dark frames other than read noise: black level errors, tails, waves, smooth maps.

Frames are (frame, height, width) in DN, of one ISO, exposure time and temperature.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from clpipe.analysis.calibration.fixed_pattern import Pixels
from clpipe.analysis.calibration.line_fit import Estimate
from clpipe.analysis.calibration.repeats import Sensor
from clpipe.analysis.report import json_object
from clpipe.base.types import Array, Doubles, Floats, Mask
from clpipe.reference.cfa import sites
from clpipe.reference.image import in_blocks

MIN_FRAMES_FOR_LEVELS = 4  # frames needed to measure the scatter of their levels
MIN_FRAMES_FOR_JUMPS = 8  # frames needed to find pixels that jump
SAMPLES = 400_000  # residuals that determine the shape of read noise
SHAPES = np.linspace(-0.4, 0.4, 17)  # shapes of the Tukey lambda distributions to compare
GROUPS = 16  # groups of samples, for the standard error of their shape
FALSE_ALARM = 1e-4  # probability of finding a wave if there is none
FINER = 8  # the number of frequencies to search, relative to the number of rows
BLOCK = 32  # px; the side of the blocks over which maps are averaged
MIN_BLOCKS = 6  # blocks along each axis
JUMPS = 10.0  # relative to the variance of other pixels; a pixel with more counts as jumping
TINY = 1e-9  # DN^2
# Half width of the correlation of a cubic B-spline, relative to the distance between its knots.
WIDTH_OF_KNOTS = 0.96


@dataclass(frozen=True)
class Wave:
    """A wave over the rows."""

    amplitude: Estimate  # DN
    period: float  # rows


@dataclass(frozen=True)
class Shading:
    """The mean dark frame without the errors of its colours, averaged over blocks of 32x32.

    Args:
        variance: the variance of the smooth part in DN^2.
        length: the distance in px between the knots of a cubic B-spline of the same smoothness.
    """

    blocks: Floats
    variance: Estimate
    length: float


@dataclass(frozen=True)
class DarkFigures:
    """Figures of dark frames in DN; None if there are too few frames."""

    color_bias: tuple[Estimate, ...]  # R, G in rows with R, G in rows with B, and B
    black_level_error: Estimate | None
    tukey_lambda: Estimate | None
    banding: Wave | None
    shading: Shading | None
    rts_share: Estimate | None
    rts_amplitude: Estimate | None

    def record(self) -> dict[str, Any]:
        """Return the figures as JSON values."""
        shading = self.shading
        return json_object(
            color_bias_dn=self.color_bias,
            black_level_error_dn=self.black_level_error,
            tukey_lambda=self.tukey_lambda,
            banding_dn=self.banding,
            dark_shading_dn=shading and shading.variance.root(),
            dark_shading_length=shading and shading.length,
            rts_share=self.rts_share,
            rts_amplitude_dn=self.rts_amplitude,
        )


def dark_figures(dark: Floats, sensor: Sensor, hot: Pixels) -> DarkFigures:
    """Return the figures of dark frames, (frame, height, width), without hot pixels."""
    good = hot.outside(dark.shape[1:])
    frames = len(dark)
    of_colours = [*sites(sensor.bayer).values()]
    levels = np.array([[float(f[s].mean(where=good[s])) for s in of_colours] for f in dark])
    mean = dark.mean(axis=0, dtype=np.float64)
    rest = (dark - mean.astype(np.float32)) * np.float32((frames / max(frames - 1, 1)) ** 0.5)
    rows = rest.mean(axis=2, dtype=np.float64)
    own = without_rows(rest)
    share, amplitude = jumps(own, good) if frames >= MIN_FRAMES_FOR_JUMPS else (None, None)
    return DarkFigures(
        color_bias=bias_of(levels, own, sensor.black_level),
        black_level_error=scatter(levels, rest, of_colours)
        if frames >= MIN_FRAMES_FOR_LEVELS
        else None,
        tukey_lambda=tukey_lambda_of(own, good) if frames > 1 else None,
        banding=banding_wave(rows - rows.mean(axis=1, keepdims=True)) if frames > 1 else None,
        shading=shading_of(mean, good, of_colours),
        rts_share=share,
        rts_amplitude=amplitude,
    )


def without_rows(rest: Floats) -> Floats:
    """Return deviations from the mean frame, less the mean of each row's even and odd columns."""
    own = rest.copy()
    for start in (0, 1):
        part = own[:, :, start::2]
        part -= part.mean(axis=2, keepdims=True)
    return own


def bias_of(levels: Doubles, own: Floats, black: float) -> tuple[Estimate, ...]:
    """Return the mean errors of the four levels in DN, from (frame, 4) levels."""
    frames = len(levels)
    pixels = float(own.var() or 1.0) / own[0].size * 4
    errors = levels.std(axis=0, ddof=1) / frames**0.5 if frames > 1 else [pixels**0.5] * 4
    pairs = zip(levels.mean(axis=0) - black, errors, strict=True)
    return tuple(Estimate(float(value), float(error)) for value, error in pairs)


def scatter(levels: Doubles, rest: Floats, own_sites: Sequence[tuple[slice, slice]]) -> Estimate:
    """Return the variation of the four levels between frames, without that of rows and pixels.

    Args:
        levels: (frame, 4), in DN.
        rest: deviations from the mean frame.
        own_sites: the sites of the four channels.
    """
    total = float(levels.var(axis=0, ddof=1).mean())
    of_rows = [rest[(slice(None), *site)].mean(axis=2, dtype=np.float64) for site in own_sites]
    explained = float(np.mean([(own.var(axis=1) / own.shape[1]).mean() for own in of_rows]))
    freedom = 4 * (len(levels) - 1)
    return Estimate(total - explained, total * (2 / freedom) ** 0.5).root()


def tukey_lambda_of(own: Floats, good: Mask) -> Estimate | None:
    """Return the shape of the Tukey lambda distribution with the L-kurtosis of read noise.

    L-moments (Hosking, J. R. Stat. Soc. B 1990) exist even if tails are too heavy for a fourth
    moment. Samples of the distribution show the effect of a mean of few frames and of whole DN.
    """
    frames = len(own)
    values = own[:, good].ravel()
    random = np.random.default_rng(0)
    values = values[random.permutation(values.size)[:SAMPLES]]
    sigma = float(np.sqrt(max(values.var() - 1 / 12, 1e-6)))
    found = l_kurtosis(values)
    parts = [l_kurtosis(part) for part in np.array_split(values, GROUPS)]
    error = float(np.std(parts, ddof=1) / GROUPS**0.5)
    u = random.random((frames, SAMPLES // frames))
    table = np.array([l_kurtosis(of_shape(u, shape, sigma)) for shape in SHAPES])
    if not table[-1] < found < table[0]:
        return None
    value = float(np.interp(found, table[::-1], SHAPES[::-1]))
    slope = abs(float(np.interp(value, SHAPES, np.gradient(table, SHAPES))))
    return Estimate(value, float(np.hypot(error, 0.4 / SAMPLES**0.5) / slope))


def of_shape(u: Doubles, shape: float, sigma: float) -> Doubles:
    """Return deviations from the mean of frames in whole DN, with Tukey lambda noise.

    The result is (frame, sample).
    """
    x = np.log(u / (1 - u)) if abs(shape) < 1e-9 else (u**shape - (1 - u) ** shape) / shape
    noise = x * (sigma / x.std())
    dn = np.rint(noise + np.linspace(-0.5, 0.5, u.shape[1]))
    return np.asarray(dn - dn.mean(axis=0))


def l_kurtosis(values: Array) -> float:
    """Return the fourth L-moment over the second; 0.1226 for Gaussian noise.

    >>> round(l_kurtosis(np.random.default_rng(0).normal(size=100_000)), 2)
    0.12
    """
    x = np.sort(values.ravel()).astype(np.float64)
    p = (np.arange(x.size) + 0.5) / x.size
    second = float((x * (2 * p - 1)).mean())
    fourth = float((x * (20 * p**3 - 30 * p**2 + 12 * p - 1)).mean())
    return fourth / second if second else 0.0


def banding_wave(rows: Doubles) -> Wave | None:
    """Return a wave in the means of rows, (frame, row), which has another phase in each frame."""
    from scipy import stats

    frames, height = rows.shape
    power = (np.abs(np.fft.rfft(rows, FINER * height)) ** 2).mean(axis=0)
    power[: 2 * FINER] = 0  # slower waves count as changes of shading
    background = float(np.median(power[2 * FINER :]) / stats.gamma.median(frames) * frames)
    peak = int(power.argmax())
    limit = stats.gamma.isf(FALSE_ALARM / height, frames) / frames
    if not background or power[peak] < limit * background:
        return None
    amplitude = 2 / height * float(np.sqrt(power[peak] - background))
    error = 2 / height * float(np.sqrt(background / (2 * frames)))
    phases = amplitude / (2 * (frames - 1))  # the mean of few frames keeps some of the wave
    return Wave(Estimate(amplitude, float(np.hypot(error, phases))), FINER * height / peak)


def shading_of(
    mean: Doubles, good: Mask, own_sites: Sequence[tuple[slice, slice]]
) -> Shading | None:
    """Return the smooth part of a mean dark frame; None if it has too few blocks."""
    flat = np.where(good, mean, np.nan)
    for site in own_sites:
        flat[site] -= np.nanmean(flat[site])
    if min(mean.shape) < MIN_BLOCKS * BLOCK:
        return None
    parts = in_blocks(flat, BLOCK)
    blocks = np.nanmean(parts, axis=(1, 3))
    noise = float(np.nanvar(parts - blocks[:, None, :, None]) / BLOCK**2)
    variance = Estimate(smooth_variance(blocks), 1.5 * noise * (2 / blocks.size) ** 0.5 + TINY)
    half = [k for k in range(2, min(blocks.shape) // 2) if diagonal(blocks, k) < variance.value / 2]
    lag = half[0] if half else min(blocks.shape) // 2
    length = lag * 2**0.5 * BLOCK / WIDTH_OF_KNOTS
    return Shading(blocks.astype(np.float32), variance, float(length))


def diagonal(blocks: Array, lag: int) -> float:
    """Return the covariance of blocks along the diagonals, which share neither rows nor columns."""
    own = blocks - blocks.mean()
    down, up = own[lag:, lag:] * own[:-lag, :-lag], own[lag:, :-lag] * own[:-lag, lag:]
    return float((down.mean() + up.mean()) / 2)


def smooth_variance(blocks: Array) -> float:
    """Return the variance of the smooth part: the covariance of blocks, extrapolated to lag 0.

    Covariance falls with the square of a small lag, so the result is (4 c(1) - c(2)) / 3.
    """
    return (4 * diagonal(blocks, 1) - diagonal(blocks, 2)) / 3


def jumps(own: Floats, good: Mask) -> tuple[Estimate | None, Estimate | None]:
    """Return the share of pixels that jump between two levels, and the levels' mean distance in DN.

    Distances have an exponential distribution, which accounts for jumps too small to be found.
    """
    variance = own.var(axis=0, dtype=np.float64, ddof=1)[good]
    usual = float(np.median(variance))
    out = variance > JUMPS * usual
    count = int(out.sum())
    if count < 2 or not usual:
        return None, None
    distances = 2 * np.sqrt(variance[out] - usual)
    least = 2 * float(np.sqrt((JUMPS - 1) * usual))
    mean = max(float(distances.mean()) - least, TINY)
    share = count / variance.size * float(np.exp(least / mean))
    amplitude = Estimate(mean, mean / count**0.5)
    spread = np.hypot(1 / count**0.5, least / mean / count**0.5)
    return Estimate(share, share * float(spread)), amplitude


def slope_and_offset(shadings: Mapping[float, Shading]) -> tuple[Estimate, Estimate]:
    """Return the standard deviations of the maps k (in DN per ISO) and b (in DN) of k ISO + b.

    A line over the ISO is fitted at each place (Feng et al., TPAMI 2023).

    Args:
        shadings: the shading at two or more ISOs.
    """
    isos = np.array(list(shadings))
    maps = np.stack([each.blocks for each in shadings.values()]).astype(np.float64)
    design = np.stack([isos, np.ones(len(isos))], axis=1)
    solve = np.linalg.pinv(design)
    both = np.tensordot(solve, maps, axes=1)
    errors = np.array([each.variance.error for each in shadings.values()])
    slope, offset = (
        Estimate(smooth_variance(one), float(np.sqrt((weights**4 * errors**2).sum()))).root()
        for one, weights in zip(both, solve, strict=True)
    )
    return slope, offset
