"""The signature of a finished picture's noise: the columns by which developments are compared.

They are the size and tails of luma noise, autocorrelations of luma and chroma, correlations of
channels, and the power spectrum of luma in four bands. The size of luma and chroma noise and the
skew of luma noise by intensity include darker shadows than the other columns, and so does the noise
of saturated colours.
"""

import itertools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from clpipe.analysis.colours import Saturated, saturated_of
from clpipe.analysis.edges import Slopes
from clpipe.analysis.signature import (
    BIN,
    DARK,
    DARKEST,
    MIN_SAMPLES,
    flat_mask,
    noise_of,
)
from clpipe.analysis.spatial import autocorrelation, count_pairs, energy_left, spectrum_of
from clpipe.base.types import Array, Doubles, Floats, Mask
from clpipe.reference.colour import LUMA, luma, rgb_to_ycbcr

MAX_LAG = 6  # px, the longest lag
# Cycles per pixel; the edges of bands. The corner of the spectrum is at 0.71.
BANDS = 0.0, 0.125, 0.25, 0.375, 0.75
LEVELS = (12, 24, 40, 64, 96, 128, 160, 192, 226)  # edges of the luma bins
RELATIVE_TO = 64  # the luma bin to which noise by intensity is relative, between cameras
BLOCK = 32  # px; the side of a block
GROUPS = 8  # groups of blocks; the jackknife omits one group at a time
# Frames that tails need, because the difference from a mean of few frames mixes their noise.
MIN_FRAMES = 4


@dataclass(frozen=True)
class Column:
    """A column of a signature: its name, and the scale of its residuals.

    A ``relative`` residual is a share of the camera's value. ``floor`` is a residual that the
    search regards as small, and is added to the standard error.
    """

    text: str
    floor: float
    relative: bool = False

    def residual(self, ours: float, theirs: float) -> float:
        """Return ours minus theirs; as a share of theirs if the column is ``relative``."""
        if not self.relative:
            return ours - theirs
        return ours / theirs - 1 if theirs else np.nan


LONG_LAGS = range(3, MAX_LAG + 1)  # lags, px
TAILS = ("kurtosis", "beyond_4_sigma")
# The ranges of luma in which the skew of noise is compared.
SKEWS = {f"skew_{low}": (low, high) for low, high in ((24, 48), (80, 112), (112, 160), (160, 220))}
SIGMA, CHROMA_SIGMA = BY_LUMA = ("sigma", "chroma_sigma")  # beginnings of names; luma follows
EDGES, WEAK = "edges", "weak_over_strong"
COLUMNS: Mapping[str, Column] = {
    "rms": Column("luma rms, levels", 0.03, relative=True),
    "kurtosis": Column("kurtosis", 0.3),
    "beyond_4_sigma": Column("beyond 4 sigma, 1e-4", 20),
    "right": Column("luma, 1 right", 0.02),
    "below": Column("luma, 1 below", 0.02),
    "diagonal": Column("luma, diagonal", 0.02),
    "two_right": Column("luma, 2 right", 0.02),
    "two_below": Column("luma, 2 below", 0.04),
    **{f"right_{lag}": Column(f"luma, {lag} right", 0.03) for lag in LONG_LAGS},
    "half": Column("luma left after 2x2", 0.02),
    "chroma_rms": Column("chroma rms, levels", 0.1, relative=True),
    "chroma_right": Column("chroma, 1 right", 0.02),
    "chroma_below": Column("chroma, 1 below", 0.03),
    "chroma_two_right": Column("chroma, 2 right", 0.04),
    **{f"chroma_right_{lag}": Column(f"chroma, {lag} right", 0.04) for lag in LONG_LAGS},
    "red_green": Column("R-G", 0.03),
    "green_blue": Column("G-B", 0.1),
    "red_blue": Column("R-B", 0.1),
    **{
        f"band_{k}": Column(f"luma power, {low:g}-{min(high, 0.71):g} cycles/px", 0.05)
        for k, (low, high) in enumerate(itertools.pairwise(BANDS), 1)
    },
    **{
        f"{name}_{low}": Column(f"{what} rms at {low}-{high - 1}, levels", floor, relative=True)
        for name, what, floor in ((SIGMA, "luma", 0.04), (CHROMA_SIGMA, "chroma", 0.08))
        for low, high in itertools.pairwise(LEVELS)
    },
    **{name: Column(f"luma skew at {low}-{high - 1}", 0.08) for name, (low, high) in SKEWS.items()},
    EDGES: Column("luma rms at edges over flat", 0.08, relative=True),
    WEAK: Column("saturated colours, weak over strong channel", 0.08, relative=True),
}


@dataclass(frozen=True, eq=False)
class ValidPixels:
    """The valid pixels of a scene, and its luma, (height, width) each.

    ``mask`` includes shadows, which are compared only by intensity and in saturated colours.
    ``bright`` excludes them, and is used for all other columns. ``slopes`` are the masks of flat
    areas and edges.
    """

    mask: Mask
    level: Doubles
    slopes: Slopes | None = None
    saturated: Saturated | None = None

    @cached_property
    def bright(self) -> Mask:
        """The valid pixels that are not dark."""
        return np.asarray(self.mask & (self.level >= DARKEST))

    def without(self, left_out: Mask) -> "ValidPixels":
        """Return the valid pixels without some of them, (height, width)."""
        slopes = self.slopes and self.slopes.within(~left_out)
        saturated = self.saturated and self.saturated.within(~left_out)
        return ValidPixels(self.mask & ~left_out, self.level, slopes, saturated)

    @cached_property
    def pairs(self) -> Doubles:
        """The number of bright pairs at each lag, (13, 13)."""
        return count_pairs(self.bright, MAX_LAG)

    def autocorrelation(self, plane: Doubles) -> Doubles:
        """Return the autocorrelation of noise, (frame, height, width), in the bright pixels.

        It is (13, 13), with lag 0 in the middle.
        """
        return autocorrelation((plane * self.bright).astype(np.float32), self.pairs)


Figures = dict[str, float]  # figures by names of COLUMNS; NaN if a figure cannot be computed


@dataclass(frozen=True)
class Noise:
    """The noise of the frames of one scene, and the luma of their mean.

    ``rgb`` is noise without drift, (frame, height, width, 3). ``level`` is luma from 0 to 255,
    (height, width).
    """

    rgb: Doubles
    level: Doubles

    @cached_property
    def planes(self) -> tuple[Doubles, Doubles, Doubles]:
        """Luma, Cb and Cr, (frame, height, width) each."""
        y, cb, cr = np.ascontiguousarray(np.moveaxis(rgb_to_ycbcr(self.rgb), -1, 0))
        return y, cb, cr


def noise_of_frames(
    frames: Sequence[Floats], mean: Doubles | Floats | None, level: Doubles | None = None
) -> Noise:
    """Return the noise of frames of one scene.

    Without ``mean``, noise is the difference from the mean of the frames times sqrt(n / (n - 1)).

    Args:
        frames: frames from 0 to 255, (height, width, 3) each.
        mean: the scene without noise.
        level: the luma by which noise is binned; None uses the mean's luma.
    """
    clean = np.mean(frames, axis=0) if mean is None else mean
    count = len(frames)
    scale = 1.0 if mean is not None else (count / (count - 1)) ** 0.5
    noise = np.stack([noise_of(frame, clean) for frame in frames])
    return Noise(noise * noise.dtype.type(scale), luma(clean) if level is None else level)


def figures_of(noise: Noise, places: ValidPixels) -> Figures:
    """Return the columns of noise over all frames, in the valid pixels."""
    found, mask = dict.fromkeys(COLUMNS, np.nan), places.bright
    if not mask.any():
        return found
    names = ("right", "below", "diagonal", "two_right", "two_below", *LONG_LAGS_RIGHT)
    y, cb, cr = noise.planes
    luma_map, *chroma_maps = map(places.autocorrelation, (y, cb, cr))
    chroma_map = (chroma_maps[0] + chroma_maps[1]) / 2
    samples = noise.rgb[:, mask].reshape(-1, 3)
    power = np.einsum("ni,nj->ij", samples, samples, dtype=np.float64) / len(samples)
    with np.errstate(invalid="ignore", divide="ignore"):
        red_green, red_blue, green_blue = (
            power[a, b] / np.sqrt(power[a, a] * power[b, b]) for a, b in ((0, 1), (0, 2), (1, 2))
        )
    found |= {
        "rms": float(np.sqrt(LUMA @ power @ LUMA)),
        "chroma_rms": float(np.sqrt(sum((p[:, mask] ** 2).mean() for p in (cb, cr)) / 2)),
        "half": energy_left(y, mask),
        **named_lags(luma_map, "", names),
        **named_lags(chroma_map, "chroma_", ("right", "below", "two_right", *LONG_LAGS_RIGHT)),
        "red_green": float(red_green),
        "green_blue": float(green_blue),
        "red_blue": float(red_blue),
        **bands(luma_map),
        **by_intensity(noise, places),
    }
    if places.slopes:
        found[EDGES] = places.slopes.ratio(y)
    return found


def signature(picture: Array, mean: Array, mask: Mask | None = None) -> Figures:
    """Return the columns of the noise of one picture.

    Args:
        picture: (height, width, 3), 0 to 255.
        mean: the same scene without noise, or the mean of many pictures of it.
        mask: the valid pixels; None uses :func:`flat_places`.

    >>> generator = np.random.default_rng(0)
    >>> grey = np.full((200, 200, 3), 128.0)
    >>> found = signature(grey + generator.normal(0, 5, grey.shape), grey)
    >>> round(found["kurtosis"], 1), round(found["half"], 2), abs(found["right"]) < 0.02
    (3.0, 0.25, True)
    """
    return figures_of(noise_of_frames([picture], mean), flat_places(mean, mask))


def flat_places(mean: Array, mask: Mask | None = None) -> ValidPixels:
    """Return the valid pixels of a picture without noise, (height, width, 3), 0 to 255.

    Without ``mask``, they are the flat ones of luma 8 to 225.
    """
    mask = flat_mask(mean, DARK) if mask is None else mask
    return ValidPixels(mask, luma(mean), saturated=saturated_of(mean, mask))


LAGS = {"right": (0, 1), "below": (1, 0), "diagonal": (1, 1)}
LAGS |= {"two_right": (0, 2), "two_below": (2, 0)}
LONG_LAGS_RIGHT = {f"right_{lag}": (0, lag) for lag in LONG_LAGS}
LAGS |= LONG_LAGS_RIGHT


def named_lags(table: Doubles, prefix: str, names: Sequence[str]) -> Figures:
    """Return named lags of a map of autocorrelation."""
    places = {name: (MAX_LAG + LAGS[name][0], MAX_LAG + LAGS[name][1]) for name in names}
    return {f"{prefix}{name}": float(table[place]) for name, place in places.items()}


def bands(table: Doubles) -> Figures:
    """Return the shares of luma's power in four bands of frequency."""
    spectrum, radius = spectrum_of(table)
    edges = itertools.pairwise(BANDS)
    inside = [spectrum[(radius >= low) & (radius < high)].sum() for low, high in edges]
    return {f"band_{k}": float(v / spectrum.sum()) for k, v in enumerate(inside, 1)}


def by_intensity(noise: Noise, places: ValidPixels) -> Figures:
    """Return the columns that need no neighbours: those by intensity, tails, and saturated colours.

    Tails are relative to the sigma of each bin of luma.
    """
    y, cb, cr = (plane[:, places.mask] for plane in noise.planes)
    level = noise.level[places.mask]
    found = {
        **rms_by_luma(SIGMA, y * y, level),
        **rms_by_luma(CHROMA_SIGMA, (cb * cb + cr * cr) / 2, level),
        **{n: skewness(y[:, (level >= a) & (level < b)]) for n, (a, b) in SKEWS.items()},
    }
    if places.saturated:
        found[WEAK] = places.saturated.ratio(noise.rgb)
    bright = level >= DARKEST
    y, level = y[:, bright], level[bright]
    bins = (level // BIN).astype(int)
    count = np.bincount(bins) * len(y)
    first = np.bincount(bins, y.sum(0))
    second = np.bincount(bins, (y**2).sum(0))
    with np.errstate(invalid="ignore", divide="ignore"):
        variance = second / count - (first / count) ** 2
        kept = (count >= MIN_SAMPLES) & (variance > 0)
        z = (y / np.sqrt(variance)[bins])[:, kept[bins]].ravel()
    if z.size:
        squares = z * z  # multiplying squares is much faster than a fourth power
        found["kurtosis"] = float((squares * squares).mean() / squares.mean() ** 2)
        found["beyond_4_sigma"] = float(1e4 * (np.abs(z) > 4).mean())
    return found


def rms_by_luma(name: str, power: Doubles, level: Doubles) -> Figures:
    """Return the rms of noise in the bins of luma; NaN for too few samples.

    Args:
        name: the beginning of the columns' names.
        power: squared noise, (frame, sample).
        level: luma of the mean, (sample,).
    """
    bins = np.digitize(level, LEVELS)
    size = len(LEVELS) + 1
    count = np.bincount(bins, minlength=size) * len(power)
    total = np.bincount(bins, power.sum(0), size)
    return {
        f"{name}_{low}": float(np.sqrt(total[k] / count[k])) if count[k] >= MIN_SAMPLES else np.nan
        for k, low in enumerate(LEVELS[:-1], 1)
    }


def skewness(noise: Doubles) -> float:
    """Return the third moment over the cubed sigma; NaN for too few samples.

    >>> round(skewness(np.array([[0.0, 0.0, 0.0, 4.0]] * 100)), 3), skewness(np.zeros((1, 4)))
    (1.155, nan)
    """
    if noise.size < MIN_SAMPLES or not (sigma := float(noise.std())):
        return float("nan")
    own = noise - noise.mean()
    return float((own * own * own).mean() / sigma**3)


def block_numbers(shape: tuple[int, ...]) -> Array:
    """Return the number of each pixel's block of 32x32 px, (height, width)."""
    rows, columns = (np.arange(size) // BLOCK for size in shape[:2])
    return np.asarray(rows[:, None] * (columns[-1] + 1) + columns[None])


def errors_of(noise: Noise, places: ValidPixels) -> Figures:
    """Return the standard errors of the columns, by the jackknife over blocks (Quenouille, 1956).

    The blocks form eight groups, each of which is omitted once.
    """
    mask = places.mask
    numbers = block_numbers(mask.shape)
    rank = {number: k for k, number in enumerate(np.unique(numbers[mask]))}
    dealt = np.array([rank.get(k, k) % GROUPS for k in range(numbers.max() + 1)])[numbers]
    parts = (places.without(dealt == group) for group in range(GROUPS))
    without = [figures_of(noise, part) for part in parts]
    errors = {}
    for name in COLUMNS:
        values = np.array([figures[name] for figures in without])
        spread = float(((values - values.mean()) ** 2).sum())
        errors[name] = np.sqrt((GROUPS - 1) / GROUPS * spread)
    return errors
