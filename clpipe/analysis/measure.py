"""Measuring the noise of images against their clean truth, or against each other."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations
from typing import Any

import numpy as np

from clpipe.analysis.pictures import SITES, WHOLE, Picture
from clpipe.analysis.selection import flat, unclipped
from clpipe.analysis.statistics import (
    HISTOGRAM,
    SIGMAS,
    Channel,
    Doubles,
    LineNoise,
    Mask,
    bin_edges,
    by_intensity,
    channel,
    correlation,
    gaussian_beyond,
    pairs_of,
    pooled,
)
from clpipe.base.errors import ImageError, RequestError
from clpipe.base.types import Floats
from clpipe.reference.cfa import red_site
from clpipe.reference.colour import rgb_to_ycbcr
from clpipe.stage import Kind

UNITS = {
    "display": "of full scale, display values",
    "rgb": "RGB before gamma",
    "mosaic": "signal: 0 = black level, 1 = white level",
    "values": "as in the file",
}


@dataclass(frozen=True)
class NoiseReport:
    """What was measured, channel by channel."""

    kind: str
    images: tuple[str, ...]
    truth: str | None  # None: the mean of the images
    width: int
    height: int
    share: float  # of the pixels (of a mosaic: of the samples) that count
    edges: Doubles  # of the intensity bins
    channels: tuple[Channel, ...]
    correlations: Mapping[tuple[str, str], float]
    notes: tuple[str, ...]

    def record(self) -> dict[str, Any]:
        """The report as JSON values; what could not be told is null."""
        return {
            "kind": self.kind,
            "unit": UNITS[self.kind],
            "images": list(self.images),
            "truth": self.truth,
            "width": self.width,
            "height": self.height,
            "share_used": self.share,
            "notes": list(self.notes),
            "channels": {one.name: channel_record(one) for one in self.channels},
            "correlation": {f"{a}-{b}": known(r) for (a, b), r in self.correlations.items()},
        }


def known(value: float) -> float | None:
    """A number as JSON has it: NaN is null."""
    return None if math.isnan(value) else float(value)


def line_record(lines: LineNoise) -> dict[str, float | None]:
    """A row or column sigma as JSON values."""
    return {"sigma": known(lines.sigma), "limit": known(lines.limit)}


def channel_record(one: Channel) -> dict[str, Any]:
    """A channel as JSON values."""
    curve, law, tails = one.curve, one.law, one.tails
    return {
        "samples": one.count,
        "sigma": one.sigma,
        "law": law and {"a": law.a, "b": law.b, "a_error": law.a_error, "b_error": law.b_error},
        "intensity": {
            "mean": curve.mean.tolist(),
            "sigma": curve.sigma.tolist(),
            "shift": curve.shift.tolist(),
            "samples": curve.count.tolist(),
        },
        "row": line_record(one.rows),
        "column": line_record(one.columns),
        "autocorrelation": [[known(r) for r in row] for row in one.autocorrelation.tolist()],
        "energy_left_2x2": known(one.energy_left),
        "skewness": known(tails.skewness),
        "excess_kurtosis": known(tails.excess_kurtosis),
        "beyond": {str(k): known(p) for k, p in zip(SIGMAS, tails.beyond, strict=True)},
        "gaussian_beyond": {str(k): gaussian_beyond(k) for k in SIGMAS},
        "histogram": {"edges": HISTOGRAM.round(2).tolist(), "samples": tails.histogram.tolist()},
    }


def measure(images: Sequence[Picture], truth: Picture | None = None) -> NoiseReport:
    """Measure the noise of images against one truth, or against their mean.

    Against the mean of n frames, noise is the difference times sqrt(n / (n - 1)); what all frames
    share, such as column noise, is then in the mean and is not seen. Clipped intensities do not
    count, see :func:`clpipe.analysis.selection.unclipped`; of pictures flat places alone do, see
    :func:`clpipe.analysis.selection.flat`.

    Args:
        images: of one kind and size.
        truth: the same without noise, of that kind and size.

    Raises:
        RequestError: a single image without a truth; images that do not fit each other.
        ImageError: no pixel counts.
    """
    first = images[0]
    if truth is None and len(images) == 1:
        raise RequestError(
            f"{first.path}: one image, and nothing to measure it against; "
            "give its clean truth (--truth) or more frames of the same scene"
        )
    for other in (*images[1:], *([truth] if truth else [])):
        if other.what != first.what:
            raise RequestError(f"{other.path} is {other.what}, but {first.path} is {first.what}")
        if other.balance and first.balance and other.balance != first.balance:
            raise RequestError(
                f"{other.path} is {other.balance}, but {first.path} is {first.balance}; "
                "keep both after the same stage of the same camera"
            )
        if other is not truth and other.iso != first.iso:
            raise RequestError(
                f"{other.path} was made at ISO {other.iso}, {first.path} at {first.iso}; "
                "repeats have one ISO"
            )
    if min(first.pixels.shape[:2]) < 2:
        raise ImageError(f"{first.path}: {first.what}: too small to measure")
    frames = np.stack([image.pixels for image in images])
    clipped = np.stack([image.clipped() for image in images])
    if first.kind == "values":
        # No levels are known; should something clip, then at the ends of what is there.
        low, high = frames.min(), frames.max()
        clipped = ((frames <= low) | (frames >= high)) & (low < high)
    if truth:
        clean, freedom, noise = truth.pixels, 1.0, frames - truth.pixels
    else:
        freedom = (len(images) - 1) / len(images)
        clean = frames.mean(0, dtype=np.float64).astype(np.float32)
        noise = (frames - clean) / np.float32(freedom**0.5)
    start = ~truth.clipped() if truth else np.ones(clean.shape, bool)
    if truth is None:
        refuse_the_odd_one(images, noise)
    notes = list(warnings_of(images, truth, noise))
    if not start.any():
        raise nothing_counts(first)
    span = clean[start]
    low, high = float(span.min()), float(span.max())
    if high > 0:  # what overshoots black is in the first bin, else the shadows had but a few
        low = max(low, 0.0)
    edges = bin_edges(low, high, first.kind != "display")
    parts = mosaic_channels if clean.ndim == 2 else picture_channels
    share, channels, correlations = parts(first, clean, noise, clipped, start, edges, freedom)
    return NoiseReport(
        kind=first.kind,
        images=tuple(str(image.path) for image in images),
        truth=str(truth.path) if truth else None,
        width=clean.shape[1],
        height=clean.shape[0],
        share=share,
        edges=edges,
        channels=channels,
        correlations=correlations,
        notes=tuple(notes),
    )


Parts = tuple[float, tuple[Channel, ...], dict[tuple[str, str], float]]


def refuse_the_odd_one(images: Sequence[Picture], noise: Floats) -> None:
    """See that no repeat has much less noise than the others: a truth among the frames.

    Raises:
        RequestError: one has.
    """
    energy = np.square(noise).mean(axis=tuple(range(1, noise.ndim)), dtype=np.float64)
    least = int(energy.argmin())
    others = float(np.median(np.delete(energy, least)))
    if len(images) > 2 and noise[0].size >= 1000 and energy[least] < 0.6 * others:
        raise RequestError(
            f"{images[least].path} has {energy[least] / others:.2g} times the others' noise; "
            "if it is their clean truth, give it as --truth"
        )


def warnings_of(images: Sequence[Picture], truth: Picture | None, noise: Floats) -> list[str]:
    """What a reader of the report must know."""
    notes = []
    if not noise.any():
        notes.append("the images are identical: there is no noise")
    if truth is None:
        notes.append(
            "against the mean of the frames: what they share, as column noise, is not seen"
        )
        if len(images) == 2:
            notes.append("with two frames every sample comes with its negative: skewness is 0")
    if images[0].kind == "values":
        notes.append("levels are not known: intensity counts from 0, so b holds a times black too")
    if images[0].kind == "mosaic":
        notes.append("b holds what rows and, against a truth, columns add to the read noise")
    if images[0].kind == "display":
        notes.append(
            "display values: variance is no straight line over intensity, a and b left out"
        )
    return notes


def nothing_counts(picture: Picture, where: str = "") -> ImageError:
    """That there is nothing to measure, in the whole picture or at a site."""
    return ImageError(
        f"{picture.path}: nothing to measure{where}: every sample is clipped, or at an intensity "
        "at which the noise reaches where it is clipped"
    )


def picture_channels(
    first: Picture,
    clean: Floats,
    noise: Floats,
    clipped: Mask,
    start: Mask,
    edges: Doubles,
    freedom: float,
) -> Parts:
    """R, G, B and Y, Cb, Cr of a picture, over the pixels that count in all of them."""
    mask: Mask = np.all(start, axis=-1)
    for c in range(3):
        mask = unclipped(clean[..., c], clipped[..., c], edges, mask)
    if not mask.any():
        raise nothing_counts(first)
    mask = flat(clean, noise, mask)
    luma = rgb_to_ycbcr(clean)[..., 0]
    planes = [clean[..., 0], clean[..., 1], clean[..., 2], luma, luma, luma]
    noises = np.concatenate([noise, rgb_to_ycbcr(noise)], axis=-1)
    names = (*Kind.RGB.channels, *Kind.YCBCR.channels)
    pairs = pairs_of(mask)
    channels, standards = [], {}
    for i, (name, plane) in enumerate(zip(names, planes, strict=True)):
        curve, without, standard = by_intensity(plane, noises[..., i], mask, edges, 1 - freedom)
        lawful = first.kind == "rgb" and name in Kind.RGB.channels
        channels.append(channel(name, curve, without, standard, mask, pairs, lawful, freedom))
        standards[name] = standard
    both = [*combinations(Kind.RGB.channels, 2), *combinations(Kind.YCBCR.channels, 2)]
    correlations = {(a, b): correlation(standards[a], standards[b], mask) for a, b in both}
    return float(mask.mean()), tuple(channels), correlations


def mosaic_channels(
    first: Picture,
    clean: Floats,
    noise: Floats,
    clipped: Mask,
    start: Mask,
    edges: Doubles,
    freedom: float,
) -> Parts:
    """The four sites of a mosaic, each a plane of its own, and the whole mosaic as one plane."""
    height, width = (size // 2 * 2 for size in clean.shape)
    whole_mask = np.zeros((height, width), bool)
    without, standard = (np.zeros((len(noise), height, width), np.float32) for _ in range(2))
    channels, curves = [], []
    x, y = red_site(first.pattern)
    places = {"R": (y, x), "G1": (y, 1 - x), "G2": (1 - y, x), "B": (1 - y, 1 - x)}
    slices = {name: np.s_[..., top:height:2, left:width:2] for name, (top, left) in places.items()}
    for name, at in slices.items():
        mask = unclipped(clean[at], clipped[at], edges, start[at])
        if not mask.any():
            raise nothing_counts(first, f" at the sites of {name}")
        curve, without[at], standard[at] = by_intensity(
            clean[at], noise[at], mask, edges, 1 - freedom
        )
        whole_mask[at] = mask
        curves.append(curve)
        pairs = pairs_of(mask)
        channels.append(channel(name, curve, without[at], standard[at], mask, pairs, True, freedom))
    everything = pooled(curves)
    pairs = pairs_of(whole_mask)
    channels.append(channel(WHOLE, everything, without, standard, whole_mask, pairs, True, freedom))
    correlations = {}
    for a, b in combinations(SITES, 2):
        both = whole_mask[slices[a]] & whole_mask[slices[b]]
        correlations[a, b] = correlation(standard[slices[a]], standard[slices[b]], both)
    return float(whole_mask.mean()), tuple(channels), correlations
