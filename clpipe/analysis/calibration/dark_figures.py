"""What dark frames show beside read noise: errors of the black level, tails, waves, smooth maps.

Frames are (frame, height, width) in DN, of one ISO, exposure time and temperature.
"""

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from clpipe.analysis.calibration.fixed_pattern import Pixels
from clpipe.analysis.calibration.line_fit import Estimate
from clpipe.analysis.calibration.repeats import Sensor
from clpipe.base.types import Array, Doubles, Floats, Mask

FEW_FOR_LEVELS = 4  # frames from which the scatter of their levels is told
FEW_FOR_JUMPS = 8  # and pixels that jump
SAMPLES = 400_000  # of residuals, for the shape of read noise
SHAPES = np.linspace(-0.4, 0.4, 17)  # of Tukey lambda distributions that are compared
GROUPS = 16  # of samples, for the error of their shape
FALSE_ALARM = 1e-4  # chance of a wave where there is none
FINER = 8  # times as many frequencies as rows, where a wave is looked for
BLOCK = 32  # px, over which maps are averaged
FEWEST_BLOCKS = 6  # each way
JUMPS = 10.0  # variance over that of the other pixels, from which a pixel jumps
TINY = 1e-9  # DN^2
WIDTH_OF_KNOTS = 0.96  # half width of the correlation of a cubic B-spline, in its knots' distance


FourEstimates = tuple[Estimate, Estimate, Estimate, Estimate]


@dataclass(frozen=True)
class Wave:
    """A wave over the rows."""

    amplitude: Estimate  # DN
    period: float  # rows


@dataclass(frozen=True)
class Shading:
    """The mean dark frame without the errors of its colours, averaged over blocks of 32x32.

    ``variance`` is that of what is smooth, DN^2; ``length`` the distance of knots, in px, of a
    cubic B-spline that is as smooth.
    """

    blocks: Floats
    variance: Estimate
    length: float


@dataclass(frozen=True)
class DarkFigures:
    """Figures of dark frames in DN; None where so few frames cannot tell."""

    color_bias: FourEstimates  # R, G in R's rows, G in B's, B
    black_level_error: Estimate | None
    tukey_lambda: Estimate | None
    banding: Wave | None
    shading: Shading | None
    rts_share: Estimate | None
    rts_amplitude: Estimate | None

    def record(self) -> dict[str, Any]:
        """The figures as JSON values."""
        shading = self.shading and asdict(self.shading.variance.root())
        return {
            "color_bias_dn": [asdict(each) for each in self.color_bias],
            "black_level_error_dn": self.black_level_error and asdict(self.black_level_error),
            "tukey_lambda": self.tukey_lambda and asdict(self.tukey_lambda),
            "banding_dn": self.banding and asdict(self.banding),
            "dark_shading_dn": shading,
            "dark_shading_length": self.shading and self.shading.length,
            "rts_share": self.rts_share and asdict(self.rts_share),
            "rts_amplitude_dn": self.rts_amplitude and asdict(self.rts_amplitude),
        }


def dark_figures(dark: Floats, sensor: Sensor, hot: Pixels) -> DarkFigures:
    """The figures of dark frames, (frame, height, width); hot pixels are left out."""
    good = np.ones(dark.shape[1:], bool)
    good[hot.rows, hot.columns] = False
    frames = len(dark)
    sites = sites_of(sensor.bayer)
    levels = np.array([[float(f[s].mean(where=good[s])) for s in sites] for f in dark])
    mean = dark.mean(axis=0, dtype=np.float64)
    rest = (dark - mean.astype(np.float32)) * np.float32((frames / max(frames - 1, 1)) ** 0.5)
    rows = rest.mean(axis=2, dtype=np.float64)
    own = without_rows(rest)
    share, amplitude = jumps(own, good) if frames >= FEW_FOR_JUMPS else (None, None)
    return DarkFigures(
        color_bias=bias_of(levels, own, sensor.black_level),
        black_level_error=scatter(levels, rest, sites) if frames >= FEW_FOR_LEVELS else None,
        tukey_lambda=shape_of(own, good) if frames > 1 else None,
        banding=wave_in(rows - rows.mean(axis=1, keepdims=True)) if frames > 1 else None,
        shading=shading_of(mean, good, sites),
        rts_share=share,
        rts_amplitude=amplitude,
    )


def sites_of(pattern: str) -> list[tuple[slice, slice]]:
    """The sites of R, G in the rows of R, G in the rows of B and B in a frame.

    >>> sites_of("GRBG")[0]
    (slice(0, None, 2), slice(1, None, 2))
    """
    red_row, blue_row = pattern.index("R") // 2, pattern.index("B") // 2
    green = [k for k, colour in enumerate(pattern) if colour == "G"]
    of_rows = {k // 2: k for k in green}
    order = pattern.index("R"), of_rows[red_row], of_rows[blue_row], pattern.index("B")
    return [(slice(k // 2, None, 2), slice(k % 2, None, 2)) for k in order]


def without_rows(rest: Floats) -> Floats:
    """Deviations from the mean frame, without those of each row's even and odd columns."""
    own = rest.copy()
    for start in (0, 1):
        part = own[:, :, start::2]
        part -= part.mean(axis=2, keepdims=True)
    return own


def bias_of(levels: Doubles, own: Floats, black: float) -> FourEstimates:
    """The mean errors of the four levels, DN, from (frame, 4) levels."""
    frames = len(levels)
    pixels = float(own.var() or 1.0) / own[0].size * 4
    errors = levels.std(axis=0, ddof=1) / frames**0.5 if frames > 1 else [pixels**0.5] * 4
    pairs = zip(levels.mean(axis=0) - black, errors, strict=True)
    one, two, three, four = (Estimate(float(value), float(error)) for value, error in pairs)
    return one, two, three, four


def scatter(levels: Doubles, rest: Floats, sites: Sequence[tuple[slice, slice]]) -> Estimate:
    """By how much the four levels differ from frame to frame, beyond what rows and pixels explain.

    Args:
        levels: (frame, 4), DN.
        rest: deviations from the mean frame.
        sites: of the four.
    """
    total = float(levels.var(axis=0, ddof=1).mean())
    of_rows = [rest[(slice(None), *site)].mean(axis=2, dtype=np.float64) for site in sites]
    explained = float(np.mean([(own.var(axis=1) / own.shape[1]).mean() for own in of_rows]))
    freedom = 4 * (len(levels) - 1)
    return Estimate(total - explained, total * (2 / freedom) ** 0.5).root()


def shape_of(own: Floats, good: Mask) -> Estimate | None:
    """The shape of the Tukey lambda distribution of which read noise has the L-kurtosis.

    L-moments (Hosking, J. R. Stat. Soc. B 1990) exist where tails are so heavy that the fourth
    moment does not. What the mean of so few frames and whole DN do to them is seen in samples of
    the distribution.
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
    """Deviations from the mean of frames of whole DN with Tukey lambda noise, (frame, sample)."""
    x = np.log(u / (1 - u)) if abs(shape) < 1e-9 else (u**shape - (1 - u) ** shape) / shape
    noise = x * (sigma / x.std())
    dn = np.rint(noise + np.linspace(-0.5, 0.5, u.shape[1]))
    return np.asarray(dn - dn.mean(axis=0))


def l_kurtosis(values: Array) -> float:
    """The fourth L-moment over the second; 0.1226 for Gaussian noise.

    >>> round(l_kurtosis(np.random.default_rng(0).normal(size=100_000)), 2)
    0.12
    """
    x = np.sort(values.ravel()).astype(np.float64)
    p = (np.arange(x.size) + 0.5) / x.size
    second = float((x * (2 * p - 1)).mean())
    fourth = float((x * (20 * p**3 - 30 * p**2 + 12 * p - 1)).mean())
    return fourth / second if second else 0.0


def wave_in(rows: Doubles) -> Wave | None:
    """A wave in the means of rows, (frame, row), of which each frame has another phase."""
    from scipy import stats

    frames, height = rows.shape
    power = (np.abs(np.fft.rfft(rows, FINER * height)) ** 2).mean(axis=0)
    power[: 2 * FINER] = 0  # what is slower is shading that changes
    background = float(np.median(power[2 * FINER :]) / stats.gamma.median(frames) * frames)
    peak = int(power.argmax())
    limit = stats.gamma.isf(FALSE_ALARM / height, frames) / frames
    if not background or power[peak] < limit * background:
        return None
    amplitude = 2 / height * float(np.sqrt(power[peak] - background))
    error = 2 / height * float(np.sqrt(background / (2 * frames)))
    phases = amplitude / (2 * (frames - 1))  # of so few frames, whose mean keeps some of the wave
    return Wave(Estimate(amplitude, float(np.hypot(error, phases))), FINER * height / peak)


def shading_of(mean: Doubles, good: Mask, sites: Sequence[tuple[slice, slice]]) -> Shading | None:
    """What is smooth in a mean dark frame; None for a frame of too few blocks."""
    flat = np.where(good, mean, np.nan)
    for site in sites:
        flat[site] -= np.nanmean(flat[site])
    height, width = (side // BLOCK * BLOCK for side in mean.shape)
    if min(height, width) < FEWEST_BLOCKS * BLOCK:
        return None
    parts = flat[:height, :width].reshape(height // BLOCK, BLOCK, width // BLOCK, BLOCK)
    blocks = np.nanmean(parts, axis=(1, 3))
    noise = float(np.nanvar(parts - blocks[:, None, :, None]) / BLOCK**2)
    variance = Estimate(smooth_variance(blocks), 1.5 * noise * (2 / blocks.size) ** 0.5 + TINY)
    half = [k for k in range(2, min(blocks.shape) // 2) if diagonal(blocks, k) < variance.value / 2]
    lag = half[0] if half else min(blocks.shape) // 2
    length = lag * 2**0.5 * BLOCK / WIDTH_OF_KNOTS
    return Shading(blocks.astype(np.float32), variance, float(length))


def diagonal(blocks: Array, lag: int) -> float:
    """The covariance of blocks along the diagonals, which share neither rows nor columns."""
    own = blocks - blocks.mean()
    down, up = own[lag:, lag:] * own[:-lag, :-lag], own[lag:, :-lag] * own[:-lag, lag:]
    return float((down.mean() + up.mean()) / 2)


def smooth_variance(blocks: Array) -> float:
    """The variance of what is smooth: the covariance of blocks, from two lags, at none.

    Covariance falls with the square of a small lag, so it is (4 c(1) - c(2)) / 3.
    """
    return (4 * diagonal(blocks, 1) - diagonal(blocks, 2)) / 3


def jumps(own: Floats, good: Mask) -> tuple[Estimate | None, Estimate | None]:
    """The share of pixels that jump between two levels, and the mean distance of these, DN.

    Distances have an exponential distribution; those that do not stand out are added by it.
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
    """Standard deviations of the maps k and b of shading = k ISO + b, in DN for an ISO and in DN.

    Feng et al., TPAMI 2023: at each place a line over the ISO.

    Args:
        shadings: by ISO, two or more.
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
