"""Compares pictures of one scene: crops next to each other, differences, and noise."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from clpipe.analysis.crops import Crop, choose_crops
from clpipe.analysis.measure import measure
from clpipe.analysis.pictures import Picture, load_picture
from clpipe.analysis.report import json_object
from clpipe.analysis.sharpness import edges_in, sharpest
from clpipe.analysis.spatial import energy_left
from clpipe.base.errors import RequestError
from clpipe.base.text import one_line
from clpipe.base.types import Doubles, Floats
from clpipe.reference.colour import luma
from clpipe.reference.curve import to_8_bit
from clpipe.reference.transfer import srgb_curve

LEVELS = 255  # sigmas are in 8-bit levels
MAX_GAIN = 64  # the largest factor by which a difference is amplified
LEFT = "2x2 leaves: the share of its variance after averaging 2x2 (independent noise: 0.25)"
SHOWN = 99  # percentile of the differences that amplification must not clip


@dataclass(frozen=True)
class Noise:
    """The noise of a picture, in levels of 255. NaN is unknown.

    Args:
        rms: the difference from the ground truth over all pixels of R, G and B.
        sigma: the standard deviation of luma in flat areas.
        left: the share of that variance that remains after averaging 2x2 pixels.
    """

    rms: float
    sigma: float
    left: float


@dataclass(frozen=True)
class Look:
    """The sharpest quarter of a picture's edges, and its tone. NaN is unknown.

    Args:
        mtf50: their MTF50, cycles/px.
        overshoot: their overshoot, a share of the contrast.
        level: the median of luma in levels of 255.
    """

    mtf50: float
    overshoot: float
    level: float


@dataclass(frozen=True)
class Row:
    """A row of a figure: its name, and a crop (or difference) for each picture, 0..1."""

    name: str
    crops: tuple[Floats, ...]  # (height, width, 3)


@dataclass(frozen=True)
class Comparison:
    """The content of a figure; ``notes`` explain its numbers and how pictures are shown."""

    labels: tuple[str, ...]
    places: tuple[Crop, ...]
    rows: tuple[Row, ...]
    noise: tuple[Noise, ...]  # noise of each picture; empty if unknown
    looks: tuple[Look, ...]
    notes: tuple[str, ...]

    def record(self) -> dict[str, Any]:
        """Return the figure's content without pixels, as JSON values; unknown numbers are None."""
        return json_object(
            labels=self.labels,
            places=self.places,
            noise=self.noise,
            looks=self.looks,
            notes=self.notes,
        )


def compare(
    paths: Sequence[Path],
    crops: Sequence[str] = (),
    labels: Sequence[str] = (),
    truths: Sequence[Path] = (),
    difference: bool = False,
) -> Comparison:
    """Compare pictures of one scene.

    Automatic crops are chosen in the mean of the ground truths, or of the pictures, so they do not
    depend on order or labels. With ground truth, noise is that of :func:`measure` in the pictures
    as shown. Without it, noise is the deviation of luma from a plane in the flat crop, if there is
    one. Mosaics are not measured, because their pattern would count as noise.

    Args:
        paths: two or more pictures of one size: finished pictures, kept images or renders.
        crops: see :func:`clpipe.analysis.crops.choose_crops`.
        labels: labels of the pictures; without any, the parts in which their paths differ.
        truths: pictures without noise: none, one for all pictures, or one for each.
        difference: whether to add rows of differences from the ground truth, or from the first
            picture.

    Raises:
        RequestError: there are too few pictures, the number of labels or truths is wrong, sizes
            differ, or a crop is not possible.
        ImageError: a picture cannot be read or shown.
    """
    _check_counts(paths, labels, truths)
    loaded = [load_picture(path) for path in paths]
    true = [load_picture(path) for path in truths]
    for other in (*loaded[1:], *true):
        if other.pixels.shape[:2] != loaded[0].pixels.shape[:2]:
            raise RequestError(
                f"{other.path} has {_size(other)}, but {loaded[0].path} has {_size(loaded[0])} "
                "pixels; give pictures of the same scene and the same size"
            )
    pictures, references = list(map(displayed, loaded)), list(map(displayed, true))
    places = choose_crops(crops, np.mean([one.pixels for one in references or pictures], axis=0))
    if references:  # there is one reference for all pictures, or one for each
        references *= len(pictures) // len(references)
    rows = [Row(place.name, tuple(place.of(one.pixels) for one in pictures)) for place in places]
    if difference:
        against = [one.pixels for one in references or pictures[:1] * len(pictures)]
        rows = _with_differences(rows, places, against)
    names = tuple(map(one_line, labels or distinct_names(paths)))
    noise: list[Noise] = []
    notes: list[str] = []
    flat = next((place for place in places if place.name == "flat"), None)
    if references:
        noise = [_against_truth(*pair) for pair in zip(pictures, references, strict=True)]
        notes = [
            f"levels of 255; rms: difference from the truth; sigma: of luma in flat places; {LEFT}"
        ]
    elif flat:
        noise = [_flat_noise(one, flat) for one in loaded]
        notes = [f"levels of 255; sigma: of luma in the flat place; {LEFT}"]
    if linear := [name for name, one in zip(names, loaded, strict=True) if one.kind != "display"]:
        notes.append(f"linear, shown through sRGB's curve: {', '.join(linear)}")
    looks = tuple(map(_look, pictures))
    return Comparison(names, tuple(places), tuple(rows), tuple(noise), looks, tuple(notes))


def _check_counts(paths: Sequence[Path], labels: Sequence[str], truths: Sequence[Path]) -> None:
    """Check the numbers of pictures, labels and ground truths.

    Raises:
        RequestError: a number is wrong.
    """
    if len(paths) < 2:
        raise RequestError(
            f"{paths[0] if paths else 'nothing'}: there is nothing to compare this picture "
            "with; give two or more pictures"
        )
    if labels and len(labels) != len(paths):
        raise RequestError(
            f"--label: found {len(labels)} for {len(paths)} pictures; give one for each, in order"
        )
    if len(truths) not in (0, 1, len(paths)):
        raise RequestError(
            f"--truth: found {len(truths)} for {len(paths)} pictures; give one for all, or one for "
            "each, in order"
        )


def _size(picture: Picture) -> str:
    height, width = picture.pixels.shape[:2]
    return f"{width}x{height}"


def displayed(picture: Picture) -> Picture:
    """Return a picture for display: linear light is encoded with sRGB's curve, mosaics are grey.

    Raises:
        RequestError: the picture is a mosaic of unknown levels.
    """
    if picture.kind == "values":
        raise RequestError(
            f"{picture.path}: this image ({picture.what}) cannot be shown; first develop it "
            "with 'clpipe run'"
        )
    pixels = picture.pixels
    if picture.kind != "display":
        curve = srgb_curve(pixels.clip(0, 1).astype(np.float64)).astype(np.float32)
        pixels = np.repeat(curve[..., None], 3, axis=2) if curve.ndim == 2 else curve
    return Picture(picture.path, "display", pixels, black=0.0, white=1.0)


def distinct_names(paths: Sequence[Path]) -> list[str]:
    """Return names that distinguish paths: file names without extension, or differing folders.

    >>> distinct_names([Path("out/a.png"), Path("out/a.iid.png")])
    ['a', 'a.iid']
    >>> distinct_names([Path("out/iso100/a.png"), Path("out/iso1600/a.png")])
    ['iso100', 'iso1600']
    >>> distinct_names([Path("x/a.png"), Path("y/a.png"), Path("y/b.png")])
    ['x/a', 'y/a', 'y/b']
    """
    for names in ([path.stem for path in paths], [path.name for path in paths]):
        if len(set(names)) == len(names):
            return names
    parts = [path.with_suffix("").parts for path in paths]
    while all(parts) and len({part[0] for part in parts}) == 1:
        parts = [part[1:] for part in parts]
    while all(parts) and len({part[-1] for part in parts}) == 1:
        parts = [part[:-1] for part in parts]
    return ["/".join(part) for part in parts]


def _with_differences(
    rows: Sequence[Row], places: Sequence[Crop], against: Sequence[Floats]
) -> list[Row]:
    """Return the rows, each followed by a row of amplified differences from ``against``."""
    differences = [
        [crop - place.of(other) for crop, other in zip(row.crops, against, strict=True)]
        for row, place in zip(rows, places, strict=True)
    ]
    sizes = np.concatenate([np.abs(crop).ravel() for row in differences for crop in row])
    largest = max(float(np.percentile(sizes, SHOWN)), 0.5 / MAX_GAIN)
    gain = 2 ** max(int(np.log2(0.5 / largest)), 0)
    found = []
    for row, crops in zip(rows, differences, strict=True):
        shown = tuple(np.float32(0.5) + np.float32(gain) * crop for crop in crops)
        found += [row, Row(f"difference x{gain}", shown)]
    return found


def _against_truth(picture: Picture, truth: Picture) -> Noise:
    """Return the noise of a picture, measured against its ground truth."""
    if np.array_equal(picture.pixels, truth.pixels):
        return Noise(0.0, 0.0, np.nan)
    (light,) = (one for one in measure([picture], truth).channels if one.name == "Y")
    rms = float(np.sqrt(np.square(picture.pixels - truth.pixels).mean(dtype=np.float64)))
    return Noise(rms * LEVELS, light.sigma * LEVELS, light.energy_left_2x2)


def _look(picture: Picture) -> Look:
    """Return the sharpness and the level of a picture for display."""
    edge = sharpest(edges_in(to_8_bit(picture.pixels)))
    sharp = (edge.mtf50, edge.overshoot) if edge else (np.nan, np.nan)
    return Look(*sharp, float(np.median(luma(picture.pixels))) * LEVELS)


def _flat_noise(picture: Picture, place: Crop) -> Noise:
    """Return the noise of a picture as deviations from a plane in a flat crop."""
    if picture.pixels.ndim == 2:
        return Noise(np.nan, np.nan, np.nan)
    noise = _without_plane(luma(place.of(displayed(picture).pixels)))
    left = energy_left(noise[None], np.ones(noise.shape, bool))
    return Noise(np.nan, float(noise.std()) * LEVELS, left)


def _without_plane(values: Doubles) -> Doubles:
    """Return (height, width) values minus the plane that fits them best."""
    y, x = np.indices(values.shape)
    terms = np.stack([np.ones(values.size), x.ravel(), y.ravel()], axis=1)
    plane, *_ = np.linalg.lstsq(terms, values.ravel(), rcond=None)
    return np.asarray(values - (terms @ plane).reshape(values.shape))
