"""Stacks of frames of one static scene, in which the variation between frames is noise."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from hashlib import blake2b

import numpy as np

from clpipe.analysis.calibration.line_fit import Estimate, Line, Table
from clpipe.base.errors import ImageError
from clpipe.base.types import Array, Floats
from clpipe.reference.cfa import PATTERNS, Pattern, sites
from clpipe.reference.filter_array import MIRRORED

# We chose these limits; tests/test_calibrate.py has a case on each side of the last two.
CLIPPING_MARGIN = 4.0  # standard deviations of a frame; the distance from clipping levels
MAX_FLICKER = 0.05  # change of mean brightness; more counts as another exposure
# Share of the variance that is correlated between neighbours; more counts as motion.
MAX_MOTION = 0.02

Site = tuple[slice, slice]  # rows and columns of one filter of the array's period


@dataclass(frozen=True)
class Sensor:
    """The pattern and levels of a sensor, which are needed to interpret its frames."""

    pattern: str  # a Bayer pattern, or the rows of another filter array
    black_level: float  # DN
    white_level: float  # DN
    filter_array: str = ""  # name of the array in a profile; "" for a Bayer pattern

    @property
    def unit(self) -> float:
        """The white level minus the black level in DN: the DN of signal 1."""
        return self.white_level - self.black_level

    @property
    def bayer(self) -> Pattern:
        """Its Bayer pattern; for another array, a substitute that is used for dark frames."""
        return next((pattern for pattern in PATTERNS if pattern == self.pattern), PATTERNS[0])

    @property
    def channels(self) -> dict[str, list[Site]]:
        """The sites of each channel: R, G1, G2 and B of a Bayer pattern, or of each filter."""
        found: dict[str, list[Site]] = {}
        for name, site in sites(self.pattern).items():
            channel = name if self.pattern in PATTERNS else name.rstrip("0123456789")
            found.setdefault(channel, []).append(site)
        return found

    @property
    def period(self) -> tuple[int, int]:
        """The numbers of rows and columns after which the filters repeat."""
        rows, columns = next(iter(sites(self.pattern).values()))
        return rows.step, columns.step


@dataclass(frozen=True)
class Rows:
    """The mean square of each row's offset over the frames, and the part due to pixel noise."""

    square: Array  # (rows,), DN^2
    explained: Array  # (rows,), DN^2; the part that pixel noise explains
    degrees: int  # degrees of freedom


@dataclass(frozen=True)
class Stack:
    """Frames of one exposure as their mean and the deviations from it, in DN.

    Args:
        light: the mean above black, (height, width).
        neighbour_mean: the mean of each pixel's neighbours of the same filter, see
        :func:`neighbour_means`.
        residuals: the frames minus their mean, (frames, height, width).
        sensor: pattern and levels.
        used: True for valid pixels.
    """

    light: Floats
    neighbour_mean: Floats
    residuals: Floats
    used: Array
    sensor: Sensor

    @property
    def degrees(self) -> int:
        """Degrees of freedom of a pixel's variance."""
        return len(self.residuals) - 1

    def variance(self) -> Array:
        """Return the sample variance of each pixel over the frames, DN^2."""
        return np.einsum("kij,kij->ij", self.residuals, self.residuals) / self.degrees

    def without_columns(self, offsets: Floats) -> "Stack":
        """Return the stack with the offsets of columns, (width,), subtracted from its light."""
        light = self.light - offsets
        return replace(self, light=light, neighbour_mean=neighbour_means(light, self.sensor.period))

    def tables(self, variance: Array) -> dict[str, Table]:
        """Return the table of each channel, from the variances of pixels, (height, width), DN^2."""
        tables = {}
        for name, places in self.sensor.channels.items():
            used = [self.used[site] for site in places]
            rows = np.concatenate(
                [
                    site[0].step * np.nonzero(own)[0] + site[0].start
                    for site, own in zip(places, used, strict=True)
                ]
            )
            s, light, around = (
                np.concatenate([x[site][own] for site, own in zip(places, used, strict=True)])
                for x in (variance, self.light, self.neighbour_mean)
            )
            tables[name] = Table.of(s, light, around, rows, self.sensor.unit, self.degrees)
        return tables


def stack_frames(frames: Floats, sensor: Sensor, what: str = "frames") -> Stack:
    """Return frames, (frames, height, width) in DN, as a stack in which all pixels are valid.

    The frames are overwritten. ``what`` is their name in messages.

    Raises:
        ImageError: two frames have equal samples.
    """
    seen: dict[bytes, int] = {}
    for k, frame in enumerate(frames, 1):
        first = seen.setdefault(blake2b(np.ascontiguousarray(frame).data).digest(), k)
        if first != k:
            raise ImageError(
                f"{what} {first} and {k} are identical in every sample. One frame was given "
                "twice, or both were made with the same seed and image key; remove one"
            )
    mean = frames.mean(axis=0, dtype=np.float64).astype(np.float32)
    rest = np.subtract(frames, mean, out=frames)
    light = mean - np.float32(sensor.black_level)
    return Stack(
        light, neighbour_means(light, sensor.period), rest, np.ones(light.shape, bool), sensor
    )


def neighbour_means(image: Floats, period: tuple[int, int]) -> Floats:
    """Return the mean of six pixels of the same filter, in the rows of a period above and below.

    They share no noise with the pixel, row noise included.
    """
    above, below = neighbour_indices(image.shape[0], period[0])
    before, behind = neighbour_indices(image.shape[1], period[1])
    rows = image[above] + image[below]
    return (rows[:, before] + rows + rows[:, behind]) / np.float32(6)


def neighbour_indices(size: int, period: int) -> tuple[Array, Array]:
    """Return, for each row, the rows one period before and after it.

    At an end, the row on the other side is returned twice, because a mirrored row (reflect-101)
    would have other filters.

    >>> [each.tolist() for each in neighbour_indices(9, 4)]
    [[4, 5, 6, 7, 0, 1, 2, 3, 4], [4, 5, 6, 7, 8, 1, 2, 3, 4]]
    """
    place = np.arange(size)
    before, behind = place - period, place + period
    first, last = before < 0, behind >= size
    if period <= MIRRORED:
        before, behind = abs(before), np.where(last, 2 * (size - 1) - behind, behind)
    else:
        before, behind = np.where(first, behind, before), np.where(last, place - period, behind)
    return before.clip(0, size - 1), behind.clip(0, size - 1)


def clipping_level(frames: Floats, sensor: Sensor) -> float:
    """Return the DN at which samples clip: the largest sample if it repeats, or the white level.

    Many cameras clip below the white level that their files state. The largest sample repeats if at
    least ten pixels have it in every frame; this number is a choice.
    """
    top = float(frames.max())
    constant = int((frames == top).all(axis=0).sum())
    return min(top, sensor.white_level) if constant >= 10 else sensor.white_level


def unclipped(stack: Stack, line: Line | None, top: float) -> Stack:
    """Return the stack without pixels that are clipped, or whose noise may be.

    With a line, the light of a pixel and of its neighbours must be more than 4 standard deviations
    from 0 DN and from ``top`` (in DN). Without a line, no sample may be at 0 DN or ``top``.
    """
    black = stack.sensor.black_level
    if line is None:
        low, high = -black - stack.light, top - black - stack.light
        used = (stack.residuals.min(axis=0) > low) & (stack.residuals.max(axis=0) < high)
    else:
        used = stack.used
        for light in (stack.light, stack.neighbour_mean):
            margin = CLIPPING_MARGIN * np.sqrt(line.at(np.maximum(light, 0)))
            used = used & (light + margin < top - black) & (light - margin > -black)
    return replace(stack, used=used)


def without_flicker(stack: Stack) -> tuple[Stack, Array]:
    """Return the stack with all frames scaled to one mean, if their means differ significantly.

    A significant difference is above four standard errors, computed over rows because of row noise.

    Returns:
        The stack, and each frame's brightness relative to the mean minus 1; zeros if unchanged.

    Raises:
        ImageError: a frame differs by more than the flicker of a lamp.
    """
    weight = stack.used.astype(np.float32)
    light = np.einsum("ij,ij->i", weight, stack.light, dtype=np.float64)
    rest = np.einsum("ij,kij->ki", weight, stack.residuals, dtype=np.float64)
    total = light.sum()
    count = weight.sum()
    unchanged = np.zeros(len(stack.residuals))
    if total <= 1e-3 * count * stack.sensor.unit:  # too dark to judge
        return stack, unchanged
    brighter = rest.sum(axis=1) / total
    scatter = rest - brighter[:, None] * light
    errors = np.sqrt((scatter**2).sum(axis=1)) / total
    if np.abs(brighter).max() > MAX_FLICKER:
        k = int(np.abs(brighter).argmax())
        raise ImageError(
            f"frame {k + 1} of {len(brighter)} is {brighter[k]:+.0%} from the mean brightness "
            "of all frames; use one exposure and steady light for all frames of an ISO"
        )
    if not (np.abs(brighter) > 4 * errors).any():
        return stack, unchanged
    for frame, by in zip(stack.residuals, brighter, strict=True):
        np.subtract(frame, np.float32(by) * stack.light, out=frame)
        np.divide(frame, np.float32(1 + by), out=frame)
    return stack, brighter


def row_offsets(stack: Stack, line: Line) -> tuple[Array, Array, Rows]:
    """Return the offset of each row in each frame: a mean weighted by inverse pixel variance.

    The weights reduce the effect of the shot noise of bright pixels.

    Returns:
        The weights, (height, width), the offsets, (frames, height) in DN, and their mean squares.
    """
    weight = np.where(stack.used, 1 / line.at(stack.neighbour_mean), 0).astype(np.float32)
    total = weight.sum(axis=1, dtype=np.float64)
    explained = np.divide(1, total, out=np.zeros_like(total), where=total > 0)
    offsets = np.einsum("ij,kij->ki", weight, stack.residuals, dtype=np.float64) * explained
    return weight, offsets, Rows((offsets**2).sum(axis=0) / stack.degrees, explained, stack.degrees)


def without_rows(stack: Stack, line: Line) -> tuple[Array, Rows]:
    """Subtract the offsets of rows from the stack, in place.

    Subtracting a row's weighted mean lowers each pixel's variance by 1 / sum(1 / variance), which
    is corrected.

    Args:
        stack: the frames.
        line: their noise without row noise.

    Returns:
        The unbiased variance of each pixel, (height, width) in DN^2, and the rows, with pixel noise
        computed from the pixels' variances.
    """
    weight, offsets, rows = row_offsets(stack, line)
    stack.residuals[...] -= offsets[:, :, None].astype(np.float32)
    variance = stack.variance() + rows.explained[:, None]
    explained = np.einsum("ij,ij->i", weight.astype(np.float64) ** 2, variance) * rows.explained**2
    return variance, replace(rows, explained=explained)


def row_variance(parts: Sequence[Rows]) -> Estimate:
    """Return the variance of row offsets in DN^2, without the part from pixel noise.

    Rows are weighted by the inverse variance of that difference.
    """
    square = np.concatenate([rows.square for rows in parts])
    explained = np.concatenate([rows.explained for rows in parts])
    degrees = np.concatenate([np.full(len(rows.square), rows.degrees) for rows in parts])
    known = explained > 0
    square, explained, degrees = square[known], explained[known], degrees[known]
    variance = 0.0
    for _ in range(8):
        weight = degrees / (max(variance, 0.0) + explained) ** 2
        variance = float(weight @ (square - explained) / weight.sum())
    residual = square - explained - variance
    return Estimate(variance, float(np.sqrt((weight**2) @ residual**2) / weight.sum()))


def common_motion(stack: Stack, line: Line) -> Estimate:
    """Return the share of its variance that a pixel shares with the pixel two rows below.

    It is 0 for noise, and larger for a moving scene, changing light or denoised raws.
    """
    weight = np.where(stack.used, 1 / np.sqrt(line.at(stack.neighbour_mean)), 0).astype(np.float32)
    products = squares = 0.0
    for frame in stack.residuals:
        standard = frame * weight
        products += float(np.vdot(standard[2:], standard[:-2]))
        squares += float(np.vdot(standard, standard))
    pairs = int((stack.used[2:] & stack.used[:-2]).sum())
    scale = stack.used.sum() / max(pairs, 1)
    return Estimate(
        products / max(squares, 1e-30) * scale, 1 / np.sqrt(max(pairs, 1) * stack.degrees)
    )


def noise_by_frame(stack: Stack, line: Line) -> Array:
    """Return the variance of each frame's noise relative to the median frame's, (frames,).

    Frames of one setting agree closely. A mean of frames, or a clean picture, has less noise.
    """
    weight = np.where(stack.used, 1 / line.at(stack.neighbour_mean), 0)
    squares = np.einsum("ij,kij,kij->k", weight, stack.residuals, stack.residuals, dtype=np.float64)
    return squares / np.median(squares)


def share_beyond_noise(stack: Stack, line: Line) -> float:
    """Return the share of pixels with more variance than noise has in one of a million pixels.

    The line is first scaled to fit the median pixel.
    """
    from scipy.stats import chi2

    degrees = stack.degrees
    ratio = (stack.variance() / line.at(stack.neighbour_mean))[stack.used]
    typical = np.median(ratio) / (chi2.ppf(0.5, degrees) / degrees)
    return float((ratio > typical * chi2.ppf(1 - 1e-6, degrees) / degrees).mean())
