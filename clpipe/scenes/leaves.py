"""Dead leaves: renders of overlapping textured shapes, with their labels and depth, from a seed.

Shapes of all sizes cover each other, as in the model of Matheron. If the density of radii falls
with the third power, edges and contrast have the statistics of photographs at every scale (Lee,
Mumford and Huang, IJCV 2001, section 4). Networks that were trained on such images denoise
photographs (Achddou, Gousseau and Ladjal, SSVM 2021).
"""

from dataclasses import dataclass
from math import ceil
from pathlib import Path

import numpy as np

from clpipe.base.errors import RequestError
from clpipe.base.types import Array, Floats
from clpipe.images.read import ReadOptions, read_source
from clpipe.images.write import write_exr
from clpipe.stage import Kind

MIN_RADIUS = 1.5  # px; the radius of the smallest leaves
MAX_RADIUS = 0.35  # of the shorter side; the radius of the largest leaves
EXPONENT = 3.0  # of the density of radii
COVERAGE = 5.0  # area of all leaves in areas of the image; about 1 % of the background is visible
SAMPLES = 3  # of a pixel along each axis; odd, so that one is at the centre
NEAR, FAR = 1.0, 10.0  # depth of the first and of the last leaf
SHAPE_AREA = 2.2  # mean area of a leaf of radius 1
MOST_LEAVES = 5_000_000

# Textures of a leaf: the share of leaves that are flat, the smallest and largest contrast of the
# others, and the smallest and largest period in px.
FLAT, CONTRAST, PERIOD = 0.2, (0.08, 0.6), (2.5, 24.0)
NOISE_SIDE = 512  # px; the side of the tile of noise that leaves with irregular texture show


@dataclass(frozen=True)
class Leaves:
    """A dead leaves image.

    Args:
        image: linear RGB, (height, width, 3) float32, at least 0; 0.18 is a middle grey.
        labels: the number of the leaf at the centre of each pixel, (height, width) uint32. Leaves
            in front have larger numbers.
        depth: its depth, (height, width) float32, from 1 to 10.
    """

    image: Floats
    labels: Array
    depth: Floats


def dead_leaves(
    width: int, height: int, seed: int, index: int = 0, palette: Floats | None = None
) -> Leaves:
    """Return a dead leaves image. The same arguments return the same image.

    >>> leaves = dead_leaves(48, 32, seed=1)
    >>> leaves.image.shape, leaves.labels.shape, float(leaves.depth.min()) >= 1
    ((32, 48, 3), (32, 48), True)

    Args:
        width: its width in px, at least 8.
        height: its height in px, at least 8.
        seed: the seed, at least 0.
        index: the number of the image among those of a seed, at least 0.
        palette: linear colours for the leaves, (count, 3), such as the pixels of a photograph. None
            draws colours.

    Raises:
        RequestError: the size is below 8x8, or needs more than five million leaves.
    """
    largest = MAX_RADIUS * min(width, height)
    area = (width + 2 * largest) * (height + 2 * largest)  # leaves also enter from outside
    of_one = SHAPE_AREA * MIN_RADIUS**2 * 2 * np.log(max(largest / MIN_RADIUS, 1.5))
    count = ceil(COVERAGE * area / of_one)
    if min(width, height) < 8 or count > MOST_LEAVES:
        raise RequestError(
            f"found {width}x{height} pixels for dead leaves; expected at least 8x8, and a size "
            f"that needs at most {MOST_LEAVES} leaves (this one: {count})"
        )
    rng = np.random.default_rng([seed, index])
    painted = _labels(rng, width, height, count)
    visible, numbers = np.unique(painted, return_inverse=True)
    labels = numbers.reshape(painted.shape).astype(np.uint32)
    count = len(visible)
    image = _shaded(rng, labels, count, palette)
    small = image.reshape(height, SAMPLES, width, SAMPLES, 3).mean((1, 3), dtype=np.float32)
    centres = labels[SAMPLES // 2 :: SAMPLES, SAMPLES // 2 :: SAMPLES]
    depth = FAR - centres * ((FAR - NEAR) / max(count - 1, 1))
    return Leaves(small, centres, np.asarray(np.maximum(depth, NEAR), np.float32))


def _labels(rng: np.random.Generator, width: int, height: int, count: int) -> Array:
    """Return the number of the leaf at each sample, painted from the back to the front."""
    columns, rows = width * SAMPLES, height * SAMPLES
    low, high = (r**-2 for r in (MIN_RADIUS, MAX_RADIUS * min(width, height)))
    radii = SAMPLES * (low + rng.random(count) * (high - low)) ** -0.5  # for EXPONENT 3
    centres = rng.random((count, 2)) * (columns + 2 * radii.max(), rows + 2 * radii.max())
    centres -= radii.max()  # leaves also enter from outside
    angles, aspects = rng.random(count) * np.pi, rng.uniform(0.4, 1.0, count)
    powers = rng.choice([1.0, 2.0, 2.0, 8.0], count)  # diamonds, ellipses, rectangles
    labels = np.zeros((rows, columns), np.uint32)
    inside = (
        np.abs(centres - (columns / 2, rows / 2)) < (columns / 2, rows / 2) + 1.5 * radii[:, None]
    ).all(1)
    for number in np.flatnonzero(inside):
        (x, y), r = centres[number], radii[number]
        reach = 1.42 * r
        left, top = max(int(x - reach), 0), max(int(y - reach), 0)
        part = labels[top : int(y + reach) + 2, left : int(x + reach) + 2]
        dx = np.arange(left, left + part.shape[1]) - x
        dy = (np.arange(top, top + part.shape[0]) - y)[:, None]
        cos, sin = np.cos(angles[number]) / r, np.sin(angles[number]) / r
        u, v = np.abs(cos * dx + sin * dy), np.abs(cos * dy - sin * dx) / aspects[number]
        p = powers[number]
        part[(u + v if p == 1 else u**p + v**p) <= 1] = number + 1
    return labels


def _shaded(rng: np.random.Generator, labels: Array, count: int, palette: Floats | None) -> Floats:
    """Return the colour of each sample: that of its leaf, times its texture and shading."""
    colours = _drawn_colours(rng, count) if palette is None else _chosen(rng, count, palette)
    contrast = _log_uniform(rng, CONTRAST, count) * (rng.random(count) >= FLAT)
    period = SAMPLES * _log_uniform(rng, PERIOD, count)
    angle, phase = rng.uniform(0, 2 * np.pi, (2, count))
    slope = rng.uniform(0, 0.4, count) / SAMPLES / 100  # of the light across the leaf, per sample
    is_noise = rng.random(count) < 0.7
    noise = _noise_tile(rng)
    shift = rng.integers(0, NOISE_SIDE, (2, count))
    cos, sin = np.cos(angle), np.sin(angle)
    values = [a.astype(np.float32) for a in (cos, sin, 2 * np.pi / period, phase, contrast, slope)]
    image = np.empty((*labels.shape, 3), np.float32)
    columns = np.arange(labels.shape[1], dtype=np.float32)
    for row, line in enumerate(labels):  # a row at a time, so that little memory is needed
        c, s, frequency, offset, amount, light = (each[line] for each in values)
        along, across = c * columns + s * np.float32(row), c * np.float32(row) - s * columns
        wave = np.sin(frequency * along + offset)
        scale = frequency * np.float32(4 / np.pi)  # a feature of the tile is 8 px of it
        u = ((scale * along).astype(np.int64) + shift[0][line]) % NOISE_SIDE
        v = ((scale * across).astype(np.int64) + shift[1][line]) % NOISE_SIDE
        texture = np.where(is_noise[line], noise[v, u], wave)
        shading = 1 + np.sin(light * along + offset) * np.float32(0.15)
        image[row] = colours[line] * np.maximum((1 + amount * texture) * shading, 0)[:, None]
    return image


def _log_uniform(rng: np.random.Generator, limits: tuple[float, float], count: int) -> Floats:
    low, high = np.log(limits)
    return np.asarray(np.exp(rng.uniform(float(low), float(high), count)), np.float32)


def _noise_tile(rng: np.random.Generator) -> Floats:
    """Return a tile of noise with the spectrum 1/f, from -1 to 1, which continues at its edges."""
    fx = np.fft.fftfreq(NOISE_SIDE)
    f = np.hypot(fx, fx[:, None])
    f[0, 0] = np.inf
    phases = np.exp(2j * np.pi * rng.random(f.shape))
    noise = np.fft.ifft2(phases / f).real
    return np.asarray(np.clip(noise / (2.5 * noise.std()), -1, 1), np.float32)


def _drawn_colours(rng: np.random.Generator, count: int) -> Floats:
    """Return linear colours with the luminances of photographs: most dark, few bright."""
    luminance = 0.12 * np.exp(rng.normal(0, 1.0, count))
    tint = np.exp(rng.normal(0, 0.25, (count, 3)))
    colours = luminance[:, None] * tint / (tint @ (0.2126, 0.7152, 0.0722))[:, None]
    return np.asarray(np.clip(colours, 0.002, 4.0), np.float32)


def _chosen(rng: np.random.Generator, count: int, palette: Floats) -> Floats:
    pixels = palette.reshape(-1, 3)
    return np.asarray(pixels[rng.integers(0, len(pixels), count)], np.float32)


def read_palette(path: Path) -> Floats:
    """Return the linear colours of a render or photograph, (count, 3), without black.

    Raises:
        ImageError: it cannot be read.
    """
    pixels = read_source(path, Kind.RGB, ReadOptions(transfer="srgb")).pixels
    colours = np.asarray(pixels, np.float32).reshape(-1, 3)
    return colours[np.isfinite(colours).all(1) & (colours.max(1) > 0)]


def write_leaves(path: Path, leaves: Leaves) -> None:
    """Write a dead leaves image as an EXR with the layers Depth and IndexOB.

    Raises:
        ImageError: it cannot be written.
    """
    layers = (leaves.image, leaves.depth[..., None], leaves.labels[..., None])
    pixels = np.concatenate([layer.astype(np.float32) for layer in layers], -1)
    write_exr(path, pixels, ("R", "G", "B", "Depth.Z", "IndexOB.X"), {})
