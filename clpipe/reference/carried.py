"""Layers beside a picture, moved as its pixels are: depth, labels, normals, optical flow, colours.

Places are counted as :mod:`clpipe.reference.geometry` counts them, and exact to float64.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

from clpipe.base.types import Array, Mask
from clpipe.reference import surfaces
from clpipe.reference.geometry import Geometry, destinations

LayerKind = Literal["depth", "label", "normal", "flow", "colour"]

# How each kind is resampled. Between two surfaces there is neither a depth nor a label, a normal or
# a vector, so there these are those of one pixel.
RESAMPLING: dict[LayerKind, str] = {
    "depth": "its inverse bilinear within a surface, else nearest",
    "label": "nearest",
    "normal": "bilinear within a surface, then made as long as 1, else nearest",
    "flow": "bilinear within a surface, else nearest, the vectors' ends mapped",
    "colour": "bilinear",
}

TIE = 1e-6  # px: so near to the border of two pixels, a place is on it

BLOCK = 1 << 17  # pixels that are moved at a time

# The channels of a vector to the right and down, and the signs of those in the file.
Vector = tuple[tuple[int, int], tuple[int, int]]


@dataclass(frozen=True)
class Layer:
    """The samples of a layer, and what they are.

    Args:
        kind: what they are.
        pixels: the data window, (rows, columns, channel) of any type.
        x, y: column and row of its first pixel in the image.
        vectors: of a flow, in px from where a surface is seen to where it is seen in another frame.
    """

    kind: LayerKind
    pixels: Array
    x: int = 0
    y: int = 0
    vectors: tuple[Vector, ...] = ()


@dataclass(frozen=True)
class Move:
    """Where some pixels of a result come from.

    Args:
        geometry: how pixels move.
        width, height: of the image.
        to: x and y of the pixels.
        origins: x and y of where they come from in the image.
    """

    geometry: Geometry
    width: int
    height: int
    to: tuple[Array, Array]
    origins: tuple[Array, Array]


def warp(
    layers: Sequence[Layer], geometry: Geometry | None, width: int, height: int
) -> tuple[list[Array], Array]:
    """Layers as a geometry moves them, and which of their pixels are known.

    Args:
        layers: of one image.
        geometry: how its pixels move; None leaves each where it is.
        width, height: of the image.

    Returns:
        Each layer, (rows, columns, channel) of its own type, but flow and what is blended of whole
        numbers as float32. It is 0 outside the image and outside the layer's data window, and a
        vector of flow is NaN that ends where the result has no place. Beside them a (rows, columns)
        mask, float16: 1 where all layers are known, else 0. A depth that is not above 0 is not.
    """
    columns, rows = geometry.size(width, height) if geometry else (width, height)
    results = [
        np.empty((rows, columns, layer.pixels.shape[2]), _type_of(layer)) for layer in layers
    ]
    valid = np.ones((rows, columns), np.float16)
    on_one = [_cells_of(layer) for layer in layers] if geometry else []
    step = max(BLOCK // columns, 1)
    for top in range(0, rows, step):
        part = slice(top, min(top + step, rows))
        y, x = np.mgrid[part, 0:columns] + 0.5
        at = geometry.origins(x, y, width, height) if geometry else (x, y)
        inside = _within(at[0], at[1], width, height)
        at = np.where(inside, at[0], 0), np.where(inside, at[1], 0)
        one_surface = np.ones(at[0].shape, bool)
        for layer, own in zip(layers, on_one, strict=False):
            if own is not None:
                corner = np.floor(at[1] - layer.y + 0.5), np.floor(at[0] - layer.x + 0.5)
                one_surface &= own[_clipped(corner[0], len(own)), _clipped(corner[1], own.shape[1])]
        moved = (_off_ties(at[0], y), _off_ties(at[1], x)) if geometry else (0.0, 0.0)
        of_pixel = at[0] + moved[0], at[1] + moved[1]
        for layer, result in zip(layers, results, strict=True):
            of_layer = at[0] - layer.x, at[1] - layer.y
            known = inside & _within(
                of_layer[0], of_layer[1], layer.pixels.shape[1], layer.pixels.shape[0]
            )
            samples = nearest(layer.pixels, of_pixel[0] - layer.x, of_pixel[1] - layer.y)
            if geometry is not None and layer.kind != "label":
                blended = _blended(layer, *of_layer)
                everywhere = layer.kind == "colour"
                samples = np.where(everywhere | one_surface[..., None], blended, samples)
                if layer.kind == "normal":
                    samples = _as_long_as_1(samples)
                elif layer.kind == "flow":
                    move = Move(geometry, width, height, (x, y), at)
                    samples = mapped(samples, layer.vectors, move)
            if layer.kind == "depth":
                valid[part] *= (samples > 0).all(-1)
            result[part] = np.where(known[..., np.newaxis], samples, 0)
            valid[part] *= known
    return results, valid


def _cells_of(layer: Layer) -> Mask | None:
    """Where a layer shows one surface, see :func:`clpipe.reference.surfaces.cells`."""
    if layer.kind == "depth":
        return surfaces.cells(_inverse(layer.pixels), surfaces.DEPTH)
    if layer.kind == "label":
        return surfaces.cells(layer.pixels, None)
    if layer.kind == "normal":
        return surfaces.cells(layer.pixels[..., :3].astype(np.float64), surfaces.NORMAL)
    if layer.kind == "flow":
        return surfaces.cells(layer.pixels.astype(np.float64), surfaces.FLOW)
    return None


def _inverse(depth: Array) -> Array:
    """1 over a depth, float64; NaN where that is none."""
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.where(depth > 0, 1 / depth.astype(np.float64), np.nan)


def _blended(layer: Layer, x: Array, y: Array) -> Array:
    """A layer between the centres of its pixels."""
    if layer.kind != "depth":
        return bilinear(layer.pixels, x, y)
    with np.errstate(divide="ignore"):
        return np.asarray(1 / bilinear(_inverse(layer.pixels), x, y))


def _off_ties(place: Array, other: Array) -> Array:
    """What moves places on the border of two pixels into one of them, the other in each other line.

    So nothing that is taken from the nearest pixel moves to one side.
    """
    on_border = abs(place - np.rint(place)) < TIE
    return np.where(on_border, np.where(np.floor(other) % 2 == 0, -0.25, 0.25), 0.0)


def nearest(pixels: Array, x: Array, y: Array) -> Array:
    """The pixels, (rows, columns, channel), in which places lie; beyond the edges those at them.

    >>> nearest(np.array([[[1], [2]]]), np.array([0.9, 1.0]), np.array([0.5, 0.5]))[:, 0].tolist()
    [1, 2]
    """
    rows, columns, channels = pixels.shape
    place = _clipped(y, rows) * columns + _clipped(x, columns)
    return pixels.reshape(-1, channels).take(place, axis=0)


def bilinear(pixels: Array, x: Array, y: Array) -> Array:
    """Pixels, (rows, columns, channel), blended between their centres, as float64.

    A pixel without weight does not count, whatever it holds.

    >>> bilinear(np.array([[[1], [2]]]), np.array([0.5, 1.25]), np.array([0.5, 0.5]))[:, 0].tolist()
    [1.0, 1.75]
    """
    left, top = np.floor(x - 0.5), np.floor(y - 0.5)
    right, down = x - 0.5 - left, y - 0.5 - top
    total: Array = np.zeros((), np.float64)
    for dx, dy in ((0, 0), (1, 0), (0, 1), (1, 1)):
        weight = ((right if dx else 1 - right) * (down if dy else 1 - down))[..., np.newaxis]
        with np.errstate(invalid="ignore"):
            part = weight * nearest(pixels, left + dx, top + dy)
        if not np.isfinite(part).all():
            part = np.where(weight > 0, part, 0)
        total = total + part
    return total


def _clipped(place: Array, size: int) -> Array:
    """The numbers of the rows or columns in which places lie, or which are nearest to them."""
    return np.clip(place, 0, size - 1).astype(np.intp)  # what is positive is cut off, not rounded


def mapped(samples: Array, vectors: Sequence[Vector], move: Move) -> Array:
    """Flow between places of an image as flow between the places of its result.

    A vector from p to p + v becomes one from where p is seen to where p + v is seen. So the other
    frame is taken to go through the same geometry.

    Args:
        samples: (..., channel), float64, that of each pixel's origin.
        vectors: see :class:`Layer`.
        move: the pixels.
    """
    result = samples.copy()
    for channels in vectors:
        ends = [
            at + sign * samples[..., channel]
            for at, (channel, sign) in zip(move.origins, channels, strict=True)
        ]
        size = move.width, move.height
        there = destinations(move.geometry, (ends[0], ends[1]), move.to, *size, move.origins)
        for to, end, (channel, sign) in zip(move.to, there, channels, strict=True):
            result[..., channel] = sign * (end - to)
    return result


def _as_long_as_1(normals: Array) -> Array:
    """Normals with their first three channels made as long as 1; those of no length stay 0."""
    length = np.linalg.norm(normals[..., :3], axis=-1, keepdims=True)
    scaled = normals[..., :3] / np.where(length > 0, length, 1)
    return np.concatenate([scaled, normals[..., 3:]], axis=-1)


def _type_of(layer: Layer) -> np.dtype:
    """The type of a layer's samples when they have been moved."""
    blended = layer.kind not in ("depth", "label") and layer.pixels.dtype.kind != "f"
    return np.dtype(np.float32) if blended or layer.kind == "flow" else layer.pixels.dtype


def _within(x: Array, y: Array, width: int, height: int) -> Array:
    """Whether places are in an image; what is not a number is not."""
    return (x >= 0) & (x <= width) & (y >= 0) & (y <= height)
