"""Measures the noise of images against their clean ground truth, or against each other."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import combinations
from typing import Any

import numpy as np

from clpipe.analysis.edges import slopes_of
from clpipe.analysis.finished import finished_figures
from clpipe.analysis.intensity import (
    NoiseCurve,
    bin_edges,
    noise_by_intensity,
    pool_curves,
    select_unclipped,
)
from clpipe.analysis.matching.columns import Figures
from clpipe.analysis.pictures import WHOLE, Picture
from clpipe.analysis.repeats import check_repeats
from clpipe.analysis.report import NoiseReport
from clpipe.analysis.spatial import count_pairs
from clpipe.analysis.statistics import Channel, channel_statistics, correlation
from clpipe.base.errors import ImageError, RequestError
from clpipe.base.extras import install_command, is_installed
from clpipe.base.types import Doubles, Floats, Mask
from clpipe.outputs.noise_areas import FLAT, HALVED, PICTURE, covariance, halved, select_flat
from clpipe.reference.cfa import sites
from clpipe.reference.colour import luma, rgb_to_ycbcr
from clpipe.stage import Kind

# The share of valid pixels, the channels, the correlations of pairs of channels, and covariances.
Parts = tuple[float, list[Channel], dict[str, float], dict[str, Doubles]]

CORRELATED = 4  # sites of a mosaic; if there are more, not all pairs are correlated


def measure(images: Sequence[Picture], truth: Picture | None = None) -> NoiseReport:
    """Measure the noise of images against one ground truth, or against their mean.

    Against the mean of n frames, noise is the difference times sqrt(n / (n - 1)). Noise that all
    frames share, such as column noise, is part of the mean and is not measured. Clipped intensities
    are ignored, see :func:`clpipe.analysis.intensity.select_unclipped`. In pictures, only flat
    areas are measured, see :func:`clpipe.outputs.noise_areas.select_flat`. The whole sigma, and the
    covariances of the whole picture before and after averaging 2x2, include every pixel.

    Args:
        images: images of one kind and size.
        truth: the image without noise, of the same kind and size.

    Raises:
        RequestError: there is a single image without a truth, the images do not match, or they are
            not repeats of one scene.
        ImageError: there are no valid pixels.
    """
    return report_of(images, truth, NoiseOf.images(images, truth))


def report_of(images: Sequence[Picture], truth: Picture | None, noise: "NoiseOf") -> NoiseReport:
    """Return the report on the noise of images.

    Raises:
        ImageError: there are no valid pixels.
    """
    first = images[0]
    if not noise.start.any():
        raise no_valid_samples(first)
    span = noise.clean[noise.start]
    low, high = float(span.min()), float(span.max())
    if high > 0:  # values below black are in the first bin, so the shadows get enough bins
        low = max(low, 0.0)
    edges = bin_edges(low, high, first.kind != "display")
    is_mosaic = noise.clean.ndim == 2
    parts = mosaic_channels if is_mosaic else picture_channels
    share, channels, correlations, covariances = parts(first, noise, edges)
    return NoiseReport(
        kind=first.kind,
        images=tuple(str(image.path) for image in images),
        truth=str(truth.path) if truth else None,
        width=noise.clean.shape[1],
        height=noise.clean.shape[0],
        share_used=share,
        edges=edges,
        channels=tuple(channels),
        correlation=correlations,
        covariance=covariances,
        notes=tuple(notes_on(images, truth, noise.noise)),
        iso=next((image.iso for image in images if image.iso), None),
        edges_over_flat=math.nan if is_mosaic else at_edges(noise),
        finished=finished(images, truth),
        rounding_variance=sum(picture.step**2 / 12 for picture in (first, truth) if picture),
    )


@dataclass(frozen=True)
class NoiseOf:
    """The noise of images of one scene, (frame, height, width[, channel]).

    ``clean`` is the image without noise, or the mean of the frames. ``clipped`` is True for clipped
    samples of the images, and ``start`` for samples that are not clipped in the truth. ``freedom``
    is the share of degrees of freedom of a sample.
    """

    clean: Floats
    noise: Floats
    clipped: Mask
    start: Mask
    freedom: float = 1.0

    @classmethod
    def images(cls, images: Sequence[Picture], truth: Picture | None) -> "NoiseOf":
        """Return the noise of images; for the arguments and errors, see :func:`measure`."""
        check_partners(images, truth)
        frames = np.stack([image.pixels for image in images])
        clipped = clipped_samples(images, frames)
        if truth:
            return cls(truth.pixels, frames - truth.pixels, clipped, ~truth.clipped())
        freedom = (len(images) - 1) / len(images)
        clean = frames.mean(0, dtype=np.float64).astype(np.float32)
        noise = (frames - clean) / np.float32(freedom**0.5)
        check_repeats(images, clean, noise)
        return cls(clean, noise, clipped, np.ones(clean.shape, bool), freedom)

    def by_intensity(
        self, intensity: Floats, noise: Floats, mask: Mask, edges: Doubles
    ) -> tuple[NoiseCurve, Floats, Floats]:
        """Return :func:`~clpipe.analysis.intensity.noise_by_intensity` of a plane."""
        return noise_by_intensity(intensity, noise, mask, edges, 1 - self.freedom)


def at_edges(noise: NoiseOf) -> float:
    """Return the rms of luma's noise in the steepest pixels over that in the flattest."""
    slopes = slopes_of(luma(noise.clean), np.all(noise.start, axis=-1))
    return slopes.ratio(luma(noise.noise))


def finished(images: Sequence[Picture], truth: Picture | None) -> Figures:
    """Return the figures of finished pictures; {} for other images, or without SciPy."""
    if images[0].kind != "display" or not is_installed("scipy"):
        return {}
    return finished_figures([image.pixels for image in images], truth.pixels if truth else None)


def check_partners(images: Sequence[Picture], truth: Picture | None) -> None:
    """Check that images and truth can be compared.

    Raises:
        RequestError: there is a single image without a truth, or the images do not match.
        ImageError: the images are too small.
    """
    first = images[0]
    if truth is None and len(images) == 1:
        raise RequestError(
            f"{first.path}: there is nothing to measure this image against; "
            "give its clean ground truth (--truth) or more frames of the same scene"
        )
    for other in (*images[1:], *([truth] if truth else [])):
        if other.what != first.what:
            raise RequestError(
                f"{other.path} is {other.what}, but {first.path} is {first.what}; give "
                "images of the same kind and size"
            )
        if other.balance and first.balance and other.balance != first.balance:
            raise RequestError(
                f"{other.path} is {other.balance}, but {first.path} is {first.balance}; keep "
                "both images after the same stage of the same camera"
            )
        isos = {other.iso, first.iso} - {None}
        if other is not truth and len(isos) > 1:
            raise RequestError(
                f"{other.path} was made at ISO {other.iso:g}, but {first.path} at ISO "
                f"{first.iso:g}; give images of one ISO"
            )
    if min(first.pixels.shape[:2]) < 2:
        raise ImageError(f"{first.path}: this image, {first.what}, is too small to measure")


def clipped_samples(images: Sequence[Picture], frames: Floats) -> Mask:
    """Return a mask that is True for clipped samples, (frame, height, width[, channel])."""
    if images[0].kind != "values":
        return np.stack([image.clipped() for image in images])
    # The clipping levels are unknown. Only the smallest and the largest samples may be clipped.
    low, high = frames.min(), frames.max()
    return ((frames <= low) | (frames >= high)) & (low < high)


def notes_on(images: Sequence[Picture], truth: Picture | None, noise: Floats) -> list[str]:
    """Return sentences that a reader of the report must know."""
    notes = []
    if not noise.any():
        notes.append("the images are identical: there is no noise")
    if truth is None:
        notes.append(
            "measured against the mean of the frames, so noise that they share, such as column "
            "noise, is excluded"
        )
        if len(images) == 2:
            notes.append(
                "with two frames, each sample has a negative counterpart, so skewness is 0"
            )
    if images[0].kind == "values":
        notes.append(
            "the levels are unknown: intensity counts from 0, so b also contains -a times black"
        )
    if images[0].kind == "mosaic":
        notes.append("b includes the variance of row and, against a truth, of column noise")
    if images[0].kind == "display":
        notes.append(
            "display values: variance is not linear in intensity, so a and b are not fitted"
        )
        if not is_installed("scipy"):
            notes.append(
                "skew and chroma noise by luma are not measured because scipy is missing. Run: "
                + install_command("scipy")
            )
    return notes


def no_valid_samples(picture: Picture, where: str = "") -> ImageError:
    """Return the error that there are no valid pixels, in the whole picture or at a site."""
    return ImageError(
        f"{picture.path}: there is nothing to measure{where}: all samples, or their noise, are "
        "clipped"
    )


def picture_channels(first: Picture, measured: NoiseOf, edges: Doubles) -> Parts:
    """Return R, G, B, Y, Cb and Cr of a picture, over pixels that are valid in all channels."""
    clean, noise = measured.clean, measured.noise
    mask: Mask = np.all(measured.start, axis=-1)
    for c in range(3):
        mask = select_unclipped(clean[..., c], measured.clipped[..., c], edges, mask)
    if not mask.any():
        raise no_valid_samples(first)
    mask = select_flat(clean, noise, mask)
    planes = [*np.moveaxis(clean, -1, 0), *[luma(clean)] * 3]
    noises = np.concatenate([noise, rgb_to_ycbcr(noise)], axis=-1)
    names = (*Kind.RGB.channels, *Kind.YCBCR.channels)
    pairs = count_pairs(mask)
    channels, standards, flat = [], {}, []
    for i, (name, plane) in enumerate(zip(names, planes, strict=True)):
        own = noises[..., i]
        curve, centred, standard = measured.by_intensity(plane, own, mask, edges)
        fits_line = first.kind == "rgb" and name in Kind.RGB.channels
        channel = channel_statistics(
            name, curve, centred, standard, mask, pairs, fits_line, measured.freedom, whole=own
        )
        if name in Kind.RGB.channels:
            flat.append(centred[:, mask])
            curve, *_ = measured.by_intensity(plane, own, np.ones_like(mask), edges)
            channel = replace(channel, intensity_picture=curve)
        channels.append(channel)
        standards[name] = standard
    both = [*combinations(Kind.RGB.channels, 2), *combinations(Kind.YCBCR.channels, 2)]
    correlations = {f"{a}-{b}": correlation(standards[a], standards[b], mask) for a, b in both}
    samples = np.stack(flat, axis=-1)[:, None]
    areas = {FLAT: samples, PICTURE: noise, HALVED: halved(noise)}
    covariances = {where: covariance(own) for where, own in areas.items()}
    return float(mask.mean()), channels, correlations, covariances


def mosaic_channels(first: Picture, measured: NoiseOf, edges: Doubles) -> Parts:
    """Return the sites of a mosaic, each as one plane, and the whole mosaic as one plane."""
    clean, noise = measured.clean, measured.noise
    own = sites(first.pattern)
    steps = next(iter(own.values()))
    height, width = (size // at.step * at.step for size, at in zip(clean.shape, steps, strict=True))
    whole_mask = np.zeros((height, width), bool)
    centred, standard = (np.zeros((len(noise), height, width), np.float32) for _ in range(2))
    slices = {
        name: np.s_[..., rows.start : height : rows.step, columns.start : width : columns.step]
        for name, (rows, columns) in own.items()
    }
    channels = []

    def add(name: str, curve: NoiseCurve, at: Any) -> None:
        mask, pairs = whole_mask[at], count_pairs(whole_mask[at])
        statistics = centred[at], standard[at], mask, pairs, True, measured.freedom
        channels.append(channel_statistics(name, curve, *statistics, whole=noise[at]))

    for name, at in slices.items():
        mask = select_unclipped(clean[at], measured.clipped[at], edges, measured.start[at])
        if not mask.any():
            raise no_valid_samples(first, f" at the sites of {name}")
        curve, centred[at], standard[at] = measured.by_intensity(clean[at], noise[at], mask, edges)
        whole_mask[at] = mask
        add(name, curve, at)
    add(WHOLE, pool_curves([channel.intensity for channel in channels]), np.s_[...])
    correlations = {}
    for a, b in combinations(slices if len(slices) <= CORRELATED else (), 2):
        both = whole_mask[slices[a]] & whole_mask[slices[b]]
        correlations[f"{a}-{b}"] = correlation(standard[slices[a]], standard[slices[b]], both)
    return float(whole_mask.mean()), channels, correlations, {}
