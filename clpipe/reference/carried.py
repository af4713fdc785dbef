"""Layers that are warped with their image: depth, labels, normals, optical flow, colours.

Positions are counted like in :mod:`clpipe.reference.geometry`, and exact to float64.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from clpipe.base.types import Array, Mask
from clpipe.reference import surfaces
from clpipe.reference.geometry import Geometry, destinations

LayerKind = Literal["depth", "label", "normal", "flow", "colour"]

# How each kind is resampled. Between two surfaces there is no valid depth, label, normal or vector,
# so each value there comes from one pixel.
RESAMPLING: dict[LayerKind, str] = {
    "depth": "its inverse bilinear within a surface, else nearest",
    "label": "nearest",
    "normal": "bilinear within a surface, then made as long as 1, else nearest",
    "flow": "bilinear within a surface, else nearest, the vectors' ends mapped",
    "colour": "bilinear",
}

TIE_DISTANCE = 1e-6  # px; a position this close to the border of two pixels counts as on the border

BLOCK = 1 << 17  # pixels that are warped at a time

# The channels that point right and down, and the signs of these directions in the file.
Vector = tuple[tuple[int, int], tuple[int, int]]


@dataclass(frozen=True)
class Layer:
    """The samples of a layer, and their meaning.

    Args:
        kind: their kind.
        pixels: the data window, (rows, columns, channel) of any type.
        x, y: column and row of its first pixel in the image.
        vectors: for flow, in px from the position of a surface to its position in another frame.
    """

    kind: LayerKind
    pixels: Array
    x: int = 0
    y: int = 0
    vectors: tuple[Vector, ...] = ()


@dataclass(frozen=True)
class PixelOrigins:
    """The origin of some pixels of a result.

    Args:
        geometry: how pixels move.
        width, height: of the image.
        to: x and y of the pixels.
        origins: x and y of their origins in the image.
    """

    geometry: Geometry
    width: int
    height: int
    to: tuple[Array, Array]
    origins: tuple[Array, Array]


def warp(
    layers: Sequence[Layer], geometry: Geometry | None, width: int, height: int
) -> tuple[list[Array], Array]:
    """Warp layers by a geometry. Returns them, and a mask of known pixels.

    Args:
        layers: layers of one image.
        geometry: how its pixels move; None moves none.
        width: the width of the image in px.
        height: its height in px.

    Returns:
        Each layer, (rows, columns, channel) of its own type. Flow, and blended layers of whole
        numbers, become float32. Pixels outside the image or outside the layer's data window are 0.
        A vector of flow is NaN if its end has no position in the result. The last item is a (rows,
        columns) mask, float16: 1 where all layers are known, else 0. A depth that is not above 0
        counts as unknown.
    """
    columns, rows = geometry.size(width, height) if geometry else (width, height)
    results = [
        np.empty((rows, columns, layer.pixels.shape[2]), _result_dtype(layer)) for layer in layers
    ]
    valid = np.ones((rows, columns), np.float16)
    surface_cells = [_single_surface_cells(layer) for layer in layers] if geometry else []
    step = max(BLOCK // columns, 1)
    for top in range(0, rows, step):
        part = slice(top, min(top + step, rows))
        y, x = np.mgrid[part, 0:columns] + 0.5
        at = geometry.origins(x, y, width, height) if geometry else (x, y)
        inside = _within(at[0], at[1], width, height)
        at = np.where(inside, at[0], 0), np.where(inside, at[1], 0)
        one_surface = np.ones(at[0].shape, bool)
        for layer, cells in zip(layers, surface_cells, strict=False):
            if cells is not None:
                corner = np.floor(at[1] - layer.y + 0.5), np.floor(at[0] - layer.x + 0.5)
                one_surface &= cells[
                    _clamped_index(corner[0], len(cells)), _clamped_index(corner[1], cells.shape[1])
                ]
        offsets = (_tie_offset(at[0], y), _tie_offset(at[1], x)) if geometry else (0.0, 0.0)
        nearest_position = at[0] + offsets[0], at[1] + offsets[1]
        for layer, result in zip(layers, results, strict=True):
            layer_position = at[0] - layer.x, at[1] - layer.y
            known = inside & _within(
                layer_position[0], layer_position[1], layer.pixels.shape[1], layer.pixels.shape[0]
            )
            samples = nearest(
                layer.pixels, nearest_position[0] - layer.x, nearest_position[1] - layer.y
            )
            if geometry is not None and layer.kind != "label":
                blended = _blended(layer, *layer_position)
                is_colour = layer.kind == "colour"
                samples = np.where(is_colour | one_surface[..., None], blended, samples)
                if layer.kind == "normal":
                    samples = _normalized(samples)
                elif layer.kind == "flow":
                    move = PixelOrigins(geometry, width, height, (x, y), at)
                    samples = map_flow(samples, layer.vectors, move)
            if layer.kind == "depth":
                valid[part] *= (samples > 0).all(-1)
            result[part] = np.where(known[..., np.newaxis], samples, 0)
            valid[part] *= known
    return results, valid


def _single_surface_cells(layer: Layer) -> Mask | None:
    """The parts of a layer that show one surface, see :func:`clpipe.reference.surfaces.cells`."""
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
    """Return 1 over a depth, float64; NaN without a depth."""
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.where(depth > 0, 1 / depth.astype(np.float64), np.nan)


def _blended(layer: Layer, x: Array, y: Array) -> Array:
    """A layer at positions between the centres of its pixels."""
    if layer.kind != "depth":
        return bilinear(layer.pixels, x, y)
    with np.errstate(divide="ignore"):
        return np.asarray(1 / bilinear(_inverse(layer.pixels), x, y))


def _tie_offset(position: Array, other: Array) -> Array:
    """Return an offset that moves positions on the border of two pixels into one of them.

    The other one is chosen in each second line, so that nearest-neighbour values do not shift to
    one side.

    """
    on_border = abs(position - np.rint(position)) < TIE_DISTANCE
    return np.where(on_border, np.where(np.floor(other) % 2 == 0, -0.25, 0.25), 0.0)


def nearest(pixels: Array, x: Array, y: Array) -> Array:
    """Return the pixels, (rows, columns, channel), at positions; the edge pixels outside.

    >>> nearest(np.array([[[1], [2]]]), np.array([0.9, 1.0]), np.array([0.5, 0.5]))[:, 0].tolist()
    [1, 2]
    """
    rows, columns, channels = pixels.shape
    index = _clamped_index(y, rows) * columns + _clamped_index(x, columns)
    return pixels.reshape(-1, channels).take(index, axis=0)


def bilinear(pixels: Array, x: Array, y: Array) -> Array:
    """Return pixels, (rows, columns, channel), interpolated between their centres, as float64.

    A pixel without weight does not contribute, whatever it contains.

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


def _clamped_index(position: Array, size: int) -> Array:
    """Return the numbers of the rows or columns that contain positions, or are nearest to them."""
    # astype() truncates positive values and does not round them.
    return np.clip(position, 0, size - 1).astype(np.intp)


def map_flow(samples: Array, vectors: Sequence[Vector], move: PixelOrigins) -> Array:
    """Convert flow between positions of an image to flow between positions of its result.

    A vector from p to p + v becomes one from the new position of p to that of p + v. The other
    frame is assumed to have the same geometry.

    Args:
        samples: (..., channel), float64, at each pixel's origin.
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
        end_positions = destinations(
            move.geometry, (ends[0], ends[1]), move.to, *size, move.origins
        )
        for to, end, (channel, sign) in zip(move.to, end_positions, channels, strict=True):
            result[..., channel] = sign * (end - to)
    return result


def between_rows(layer: Layer, directions: Sequence[int], row_step: float) -> Layer:
    """Return flow between moments one frame apart as flow between the moments of rolling rows.

    A surface that moves by v in a frame is seen in another row y' of the other frame, and so
    (y' - y) * row_step frames later. It then has moved by v / (1 - v_y row_step), and back in time
    by v / (1 + v_y row_step). Its velocity is assumed to be constant for this difference.

    Args:
        layer: the layer, in the render's px.
        directions: for each vector, whether it leads forward (1) or back (-1) in time.
        row_step: the time from the start of a row to the start of the next, in frames.

    Returns:
        The layer, float64. A vector is NaN if its surface moves like the shutter, or faster.
    """
    result = layer.pixels.astype(np.float64)
    for ((across, _), (down, sign)), direction in zip(layer.vectors, directions, strict=True):
        slower = 1 - direction * row_step * sign * result[..., down]
        with np.errstate(divide="ignore", invalid="ignore"):
            factor = np.where(slower > 0, 1 / slower, np.nan)
        result[..., [across, down]] *= factor[..., np.newaxis]
    return replace(layer, pixels=result)


def _normalized(normals: Array) -> Array:
    """Scale the first three channels of normals to length 1; normals of length 0 stay 0."""
    length = np.linalg.norm(normals[..., :3], axis=-1, keepdims=True)
    scaled = normals[..., :3] / np.where(length > 0, length, 1)
    return np.concatenate([scaled, normals[..., 3:]], axis=-1)


def _result_dtype(layer: Layer) -> np.dtype:
    """Return the type of a layer's samples after warping."""
    blended = layer.kind not in ("depth", "label") and layer.pixels.dtype.kind != "f"
    return np.dtype(np.float32) if blended or layer.kind == "flow" else layer.pixels.dtype


def _within(x: Array, y: Array, width: int, height: int) -> Array:
    """Return whether positions are in an image; NaN is not."""
    return (x >= 0) & (x <= width) & (y >= 0) & (y <= height)
