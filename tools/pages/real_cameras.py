"""Compares real cameras' finished pictures with clpipe's: signatures, plots, crops."""

from collections import defaultdict
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure
from PIL import Image

import clpipe
from clpipe.analysis.crops import choose_crops
from clpipe.analysis.matching.columns import Figures, signature
from clpipe.analysis.signature import BIN, MIN_SAMPLES, flat_mask, noise_of
from clpipe.analysis.spatial import autocorrelation, count_pairs
from clpipe.base.types import Array, Doubles, Floats
from clpipe.engine.device import open_device
from clpipe.engine.runner import Runner
from clpipe.images.jpeg import JpegEncoding, jpeg_round_trip
from clpipe.reference.colour import luma
from tools.shared.pairs import find_pairs
from tools.shared.pictures import enlarged, sheet
from tools.shared.plots import caption, caption_spectrum, save, spectrum
from tools.shared.tables import COLUMNS, cells

ISOS = (800, 1600, 3200, 6400)
CAMERAS = {"5dmark3": "Canon 5D Mark III", "d600": "Nikon D600", "d800": "Nikon D800"}
PLACES = ("saturated", "textured")  # of crops
SCALE = 4  # their enlargement

# Medians over cameras' own JPEGs in native size, measured by clpipe.analysis.matching.columns.
# Noise is a picture minus the mean of many of the same scene. The pictures are not part of the
# repository. They are from Nam, Hwang, Matsushita and Kim, "A holistic approach to cross-channel
# image noise modeling and its application to image denoising" (CVPR 2016).
MEASURED: dict[str, dict[str, float]] = {
    name: dict(zip((attribute for _, attribute, _ in COLUMNS), values, strict=True))
    for name, values in {
        "Canon 5D Mark III, ISO 3200": (3.9, 5.3, 29, 0.51, 0.47, 0.28, 0.09, 0.57, 0.84, 0.65),
        "Nikon D800, ISO 1600": (4.0, 3.5, 5, 0.55, 0.55, 0.29, 0.10, 0.59, 0.88, 0.48),
        "Nikon D800, ISO 3200": (5.3, 3.4, 5, 0.59, 0.60, 0.35, 0.14, 0.63, 0.83, 0.40),
    }.items()
}

# Target ranges of a camera-like development, lowest and highest, around these cameras.
RANGES: dict[str, tuple[float, float]] = {
    "kurtosis": (3.0, 5.5),
    "beyond_4_sigma": (0, 30),
    "right": (0.42, 0.68),
    "below": (0.42, 0.66),
    "diagonal": (0.22, 0.42),
    "two_right": (0.04, 0.21),
    "half": (0.52, 0.70),
    "chroma_right": (0.75, 0.95),
    "red_green": (0.20, 0.75),
}


@dataclass(frozen=True)
class Pair:
    """A picture and the same picture without noise, (height, width, 3) uint8."""

    noisy: Array
    clean: Array

    def signature(self) -> Figures:
        """Return the figures of the table."""
        return signature(self.noisy, self.clean)


def read_pairs(folder: Path) -> dict[str, list[Pair]]:
    """Read the pairs of a folder by camera."""
    found: dict[str, list[Pair]] = defaultdict(list)
    for each in find_pairs(folder):
        found[each.camera].append(Pair(_read(each.real), _read(each.mean)))
    return {name_of(camera): pairs for camera, pairs in found.items()}


def name_of(key: str) -> str:
    """Return the name of a camera and its ISO, from the name of its files.

    >>> name_of("5dmark3_iso3200")
    'Canon 5D Mark III, ISO 3200'
    """
    camera, _, iso = key.partition("_iso")
    name = CAMERAS.get(camera, camera)
    return f"{name}, ISO {iso}" if iso else name


def _read(path: Path) -> Array:
    with Image.open(path) as image:
        return np.asarray(image.convert("RGB"))


def develop(render: Floats, iso: float, device: str | None = None) -> Pair:
    """Develop a render with the default chain, as a decoded JPEG, and its ground truth.

    Args:
        render: (height, width, 3), linear.
        iso: the ISO.
        device: the device, as for :class:`clpipe.Pipeline`.
    """
    pipeline = clpipe.Pipeline(iso=iso, device=device)
    ideal = Runner(pipeline.chain.without_noise(), open_device(device))
    truth = ideal.run(render, "render").encoded
    output = pipeline.chain.settings.output
    written = JpegEncoding(output.jpeg_quality, output.jpeg_subsampling)
    picture = np.asarray(pipeline.process(render, "render").image)
    return Pair(jpeg_round_trip(picture, written), np.asarray(truth))


def medians(pairs: Iterable[Pair]) -> dict[str, float]:
    """Return the median of each figure over several pairs."""
    records = [pair.signature() for pair in pairs]
    return {name: float(np.median([record[name] for record in records])) for name in records[0]}


def outside(record: Mapping[str, float]) -> list[str]:
    """Return the figures whose rounded values are outside their target range, or NaN."""
    shown = {of: float(format(record[of], form)) for _, of, form in COLUMNS}
    return [name for name, (low, high) in RANGES.items() if not low <= shown[name] <= high]


def row(name: str, record: Mapping[str, float], marked: Sequence[str] = ()) -> list[str]:
    """Return a row of the table, with marked columns in bold."""
    texts = zip(COLUMNS, cells(record), strict=True)
    return [name, *(f"**{text}**" if of in marked else text for (_, of, _), text in texts)]


def range_row() -> list[str]:
    """Return the row of the target ranges."""
    texts = [
        f"{RANGES[of][0]:{form}} - {RANGES[of][1]:{form}}" if of in RANGES else ""
        for _, of, form in COLUMNS
    ]
    return ["target", *texts]


def spectrum_of(pair: Pair) -> tuple[Doubles, Doubles]:
    """Return the power spectrum of luma noise in flat areas: frequencies in cycles per px, power.

    >>> grey = np.full((128, 128, 3), 128.0)
    >>> noisy = grey + np.random.default_rng(0).normal(0, 5, grey.shape)
    >>> bool(np.allclose(spectrum_of(Pair(noisy, grey))[1], 1, atol=0.3))
    True
    """
    mask = flat_mask(pair.clean)
    noise = np.where(mask, luma(noise_of(pair.noisy, pair.clean)), 0)
    return spectrum(autocorrelation(noise[None].astype(np.float32), count_pairs(mask)))


def sigma_by_intensity(pairs: Iterable[Pair]) -> tuple[Doubles, Doubles]:
    """Return clean luma and the sigma of luma noise in flat areas, both in levels.

    >>> ramp = np.repeat(np.linspace(40, 200, 400)[None, :, None], 3, 2).repeat(200, 0)
    >>> noisy = ramp + np.random.default_rng(0).normal(0, 1, (200, 400, 1)) * ramp / 20
    >>> levels, sigmas = sigma_by_intensity([Pair(noisy, ramp)])
    >>> bool(np.allclose(sigmas, levels / 20, rtol=0.2))
    True
    """
    parts = []
    for pair in pairs:
        mask = flat_mask(pair.clean)
        noise = luma(noise_of(pair.noisy, pair.clean))
        parts.append(np.stack([luma(pair.clean)[mask], noise[mask]]))
    level, noise = np.concatenate(parts, axis=1)
    bins = (level // BIN).astype(int)
    count = np.bincount(bins)
    variance = np.bincount(bins, noise**2) / np.maximum(count, 1)
    full = np.flatnonzero(count >= MIN_SAMPLES)
    return (full + 0.5) * BIN, np.sqrt(variance[full])


def draw(
    real: Mapping[str, Sequence[Pair]], ours: Mapping[str, Sequence[Pair]], path: Path
) -> None:
    """Draw power spectra, and sigma over intensity, as an SVG; cameras are dashed."""
    figure = Figure(figsize=(12, 4.5), layout="constrained")
    spectra, intensity = figure.subplots(1, 2)
    for group, style in ((real, "--"), (ours, "-")):
        for name, pairs in group.items():
            each = [spectrum_of(pair) for pair in pairs]
            power = np.median([power for _, power in each], axis=0)
            (line,) = spectra.plot(each[0][0], power, style, label=name)
            levels, sigmas = sigma_by_intensity(pairs)
            intensity.plot(levels, sigmas, style, color=line.get_color(), label=name)
    caption_spectrum(spectra, "Power spectrum of luma noise")
    titles = (
        "Noise by intensity",
        "luma without noise, 8-bit levels",
        "standard deviation of luma noise, 8-bit levels",
    )
    caption(intensity, *titles)
    intensity.set_ylim(bottom=0)
    figure.legend(*spectra.get_legend_handles_labels(), loc="outside right center")
    save(figure, path)


def crops(groups: Mapping[str, Pair]) -> Image.Image:
    """Draw two crops of each picture at 400 %, with a column for each picture."""
    rows: dict[str, list[tuple[str, Array]]] = {place: [] for place in PLACES}
    for name, pair in groups.items():
        for place in choose_crops(PLACES, pair.clean.astype(np.float32) / np.float32(255)):
            heading = name if place.name == PLACES[0] else ""
            rows[place.name].append((heading, enlarged(place.of(pair.noisy), SCALE)))
    return sheet(rows.values(), PLACES)
