"""Stacks of frames that show the same: what moves from frame to frame is noise."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from hashlib import blake2b

import numpy as np

from clpipe.analysis.calibration.line_fit import Estimate, Line, Table
from clpipe.base.errors import ImageError
from clpipe.base.types import Array, Floats
from clpipe.reference.cfa import Pattern, red_site

CHANNELS = ("R", "G1", "G2", "B")
FAR_FROM_CLIPPING = 4.0  # standard deviations
LARGEST_FLICKER = 0.05  # a lamp flickers by less; more is another exposure
MOVING = 0.02  # share of the variance that neighbours have in common


@dataclass(frozen=True)
class Sensor:
    """What must be known of a sensor to read its frames."""

    pattern: Pattern
    black_level: float  # DN
    white_level: float  # DN

    @property
    def unit(self) -> float:
        """The white level above black in DN: signal 1."""
        return self.white_level - self.black_level

    def sites(self) -> dict[str, tuple[slice, slice]]:
        """Where a mosaic's channels are; G1 stands in the rows of red.

        >>> Sensor("GRBG", 0, 1).sites()["R"]
        (slice(0, None, 2), slice(1, None, 2))
        """
        x, y = red_site(self.pattern)
        places = ((y, x), (y, 1 - x), (1 - y, x), (1 - y, 1 - x))
        return {
            name: (slice(row, None, 2), slice(column, None, 2))
            for name, (row, column) in zip(CHANNELS, places, strict=True)
        }


@dataclass(frozen=True)
class Rows:
    """Offsets of rows: their mean square over the frames, what pixel noise explains of it."""

    square: Array  # (rows,), DN^2
    explained: Array
    degrees: int


@dataclass(frozen=True)
class Stack:
    """Frames less their mean, all of one exposure.

    ``light`` is the mean above black (height, width), ``around`` the mean of its neighbours of the
    same colour in other rows, ``rest`` (frames, height, width) what is left of the frames, all in
    DN; ``used`` are the pixels that count.
    """

    light: Floats
    around: Floats
    rest: Floats
    used: Array
    sensor: Sensor

    @property
    def degrees(self) -> int:
        """Degrees of freedom of a pixel's variance."""
        return len(self.rest) - 1

    def variance(self) -> Array:
        """The sample variance of each pixel over the frames, DN^2."""
        return np.einsum("kij,kij->ij", self.rest, self.rest) / self.degrees

    def without_columns(self, offsets: Floats) -> "Stack":
        """The stack without the columns' own offsets, (width,), which are no light."""
        light = self.light - offsets
        return replace(self, light=light, around=neighbours(light))

    def tables(self, variance: Array) -> dict[str, Table]:
        """A table of variances a channel."""
        found = {}
        for name, site in self.sensor.sites().items():
            used = self.used[site]
            rows = 2 * np.nonzero(used)[0] + site[0].start
            s, light, around = (x[site][used] for x in (variance, self.light, self.around))
            found[name] = Table.of(s, light, around, rows, self.sensor.unit, self.degrees)
        return found


def stacked(frames: Floats, sensor: Sensor, what: str = "frames") -> Stack:
    """Frames (frames, height, width) in DN, which are used up, as a stack; all pixels count.

    ``what`` the frames are called in messages.

    Raises:
        ImageError: two frames are equal sample by sample.
    """
    seen: dict[bytes, int] = {}
    for k, frame in enumerate(frames, 1):
        first = seen.setdefault(blake2b(np.ascontiguousarray(frame).data).digest(), k)
        if first != k:
            raise ImageError(
                f"{what} {first} and {k} are identical in every sample; one frame was given "
                "twice, or both were made with one seed and image key"
            )
    mean = frames.mean(axis=0, dtype=np.float64).astype(np.float32)
    rest = np.subtract(frames, mean, out=frames)
    light = mean - np.float32(sensor.black_level)
    return Stack(light, neighbours(light), rest, np.ones(light.shape, bool), sensor)


def neighbours(image: Floats) -> Floats:
    """The mean of the six pixels of the same colour two rows above and below each pixel.

    They share no noise with it, that of its row included.
    """
    padded = np.pad(image, 2, mode="reflect")
    rows = padded[:-4] + padded[4:]
    return (rows[:, :-4] + rows[:, 2:-2] + rows[:, 4:]) / np.float32(6)


def ceiling(frames: Floats, sensor: Sensor) -> float:
    """Where the samples clip, in DN: the white level, or the largest sample if it stays put.

    Many cameras clip below the white level that their files name.
    """
    top = float(frames.max())
    stuck = int((frames == top).all(axis=0).sum())
    return min(top, sensor.white_level) if stuck >= 10 else sensor.white_level


def unclipped(stack: Stack, line: Line | None, top: float) -> Stack:
    """The stack with those pixels counted whose light, and whose neighbours', lies more than 4
    standard deviations of a frame from clipping; without a line, those that touch neither end.
    """
    black = stack.sensor.black_level
    if line is None:
        low, high = -black - stack.light, top - black - stack.light
        used = (stack.rest.min(axis=0) > low) & (stack.rest.max(axis=0) < high)
    else:
        used = stack.used
        for light in (stack.light, stack.around):
            margin = FAR_FROM_CLIPPING * np.sqrt(line.at(np.maximum(light, 0)))
            used = used & (light + margin < top - black) & (light - margin > -black)
    return replace(stack, used=used)


def without_flicker(stack: Stack) -> tuple[Stack, Array]:
    """The stack with all frames scaled to the same mean, where their means differ by more than
    four standard errors (which rows give, since noise may be shared within a row).

    Returns:
        The stack, and by how much each frame was brighter than the mean; zeros if none was.

    Raises:
        ImageError: a frame differs by more than a lamp's flicker.
    """
    weight = stack.used.astype(np.float32)
    light = np.einsum("ij,ij->i", weight, stack.light, dtype=np.float64)
    rest = np.einsum("ij,kij->ki", weight, stack.rest, dtype=np.float64)
    total = light.sum()
    count = weight.sum()
    none = np.zeros(len(stack.rest))
    if total <= 1e-3 * count * stack.sensor.unit:
        return stack, none  # too dark to tell
    brighter = rest.sum(axis=1) / total
    scatter = rest - brighter[:, None] * light
    errors = np.sqrt((scatter**2).sum(axis=1)) / total
    if np.abs(brighter).max() > LARGEST_FLICKER:
        k = int(np.abs(brighter).argmax())
        raise ImageError(
            f"frame {k + 1} of {len(none)} is {brighter[k]:+.0%} from the mean brightness of all; "
            "frames of one ISO must have one exposure and steady light"
        )
    if not (np.abs(brighter) > 4 * errors).any():
        return stack, none
    for frame, by in zip(stack.rest, brighter, strict=True):
        frame -= np.float32(by) * stack.light
        frame /= np.float32(1 + by)
    return stack, brighter


def row_offsets(stack: Stack, line: Line) -> tuple[Array, Array, Rows]:
    """The offset that each row has in each frame: its mean, weighted by inverse variance, so a
    bright row's shot noise does not hide it.

    Returns:
        The weights (height, width), the offsets (frames, height), and what the rows say.
    """
    weight = np.where(stack.used, 1 / line.at(stack.around), 0).astype(np.float32)
    total = weight.sum(axis=1, dtype=np.float64)
    explained = np.divide(1, total, out=np.zeros_like(total), where=total > 0)
    offsets = np.einsum("ij,kij->ki", weight, stack.rest, dtype=np.float64) * explained
    return weight, offsets, Rows((offsets**2).sum(axis=0) / stack.degrees, explained, stack.degrees)


def without_rows(stack: Stack, line: Line) -> tuple[Array, Rows]:
    """Take the rows' offsets out of the stack, in place, by a line that has no row noise in it.

    That takes 1/sum(1/variance) of each pixel's variance along, which is given back.

    Returns:
        The variance of each pixel, unbiased, and what the rows say, pixel noise now by the pixels'
        own variances.
    """
    weight, offsets, rows = row_offsets(stack, line)
    stack.rest[...] -= offsets[:, :, None].astype(np.float32)
    variance = stack.variance() + rows.explained[:, None]
    explained = np.einsum("ij,ij->i", weight.astype(np.float64) ** 2, variance) * rows.explained**2
    return variance, replace(rows, explained=explained)


def row_variance(parts: Sequence[Rows]) -> Estimate:
    """The variance of row offsets in DN^2: mean square less what pixel noise explains, weighted by
    how well each row tells it.
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
    """The share of the variance that a pixel has in common with the neighbour two rows below.

    Noise has none; a scene that moves, changing light and raws that were denoised have.
    """
    weight = np.where(stack.used, 1 / np.sqrt(line.at(stack.around)), 0).astype(np.float32)
    products = squares = 0.0
    for frame in stack.rest:
        standard = frame * weight
        products += float(np.vdot(standard[2:], standard[:-2]))
        squares += float(np.vdot(standard, standard))
    pairs = int((stack.used[2:] & stack.used[:-2]).sum())
    scale = stack.used.sum() / max(pairs, 1)
    return Estimate(
        products / max(squares, 1e-30) * scale, 1 / np.sqrt(max(pairs, 1) * stack.degrees)
    )


def noise_by_frame(stack: Stack, line: Line) -> Array:
    """How strong each frame's own noise is, as variance over that of the median frame, (frames,).

    All frames have the same, up to a per mille; the mean of others, or a clean picture, has less.
    """
    weight = np.where(stack.used, 1 / line.at(stack.around), 0)
    squares = np.einsum("ij,kij,kij->k", weight, stack.rest, stack.rest, dtype=np.float64)
    return squares / np.median(squares)


def share_beyond_noise(stack: Stack, line: Line) -> float:
    """The share of pixels whose variance no noise has (one in a million would), from a line that
    is first brought down to the median pixel.
    """
    from scipy.stats import chi2

    degrees = stack.degrees
    ratio = (stack.variance() / line.at(stack.around))[stack.used]
    typical = np.median(ratio) / (chi2.ppf(0.5, degrees) / degrees)
    return float((ratio > typical * chi2.ppf(1 - 1e-6, degrees) / degrees).mean())
