"""Carried layers of panoramas: combined in one atlas, and warped like the picture."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from clpipe.base.types import Array
from clpipe.chain.carry import AovSpec
from clpipe.chain.chain import Chain
from clpipe.chain.panorama import projection_of
from clpipe.images.pixels import display_window
from clpipe.images.read import SourceImage
from clpipe.inputs.carry import (
    CarriedLayer,
    CarriedLayers,
    attributes_of,
    find_same_layers,
    geometry_of,
    read_layer_samples,
    record_of,
)
from clpipe.inputs.panoramas import pieces
from clpipe.reference.carried import Layer, warp
from clpipe.reference.geometry import Composition, Geometry
from clpipe.reference.panorama import LatitudeLongitude, Panorama, Views
from clpipe.reference.projection import Projection

DISTANCE = "Distance"


def carry_panorama(
    paths: Sequence[Path],
    source: SourceImage,
    chain: Chain,
    layers: Sequence[AovSpec],
    max_pixels: int,
    orientation: int = 1,
) -> CarriedLayers:
    """Return the layers of a panorama, warped like its picture.

    Depth along the axis of each view is converted to depth along the picture's axis. It is 0 at
    right angles to that axis, and negative at larger angles. The channel "Distance" is added. The
    depth of a latitude-longitude map is a distance already. Normals are in world space and do not
    change.

    Args:
        paths: the files of the panorama.
        source: the image, an atlas.
        chain: the chain whose stages move pixels.
        layers: the layers to carry.
        max_pixels: a file with more pixels is rejected before it is read.
        orientation: the EXIF orientation that is applied to the picture at the end.

    Raises:
        ImageError: as for :func:`clpipe.inputs.carry.carry`, or the files have different layers.
    """
    panorama, projection = source.panorama, projection_of(chain)
    assert panorama
    assert projection
    sources_by_file = find_same_layers(paths, layers)
    size = file_size(panorama, len(paths))
    read = []
    for matching in zip(*sources_by_file, strict=True):
        images: list[Array] = []
        for path, each in zip(paths, matching, strict=True):
            pixels, place = read_layer_samples(each, path, size, max_pixels)
            images += pieces(panorama, display_window(pixels, *place, *size))
        first = matching[0]
        if first.kind == "depth" and isinstance(panorama, Views):
            images = [
                (image * view.lengths()[..., None]).astype(np.float32)
                for image, view in zip(images, panorama.views, strict=True)
            ]
        filter_ = {"label": "nearest", "flow": ""}.get(first.kind, "linear")
        read.append(Layer(first.kind, panorama.atlas(images, filter_), vectors=first.vectors))
    geometry = geometry_of(chain, orientation)
    warped, valid = warp(read, geometry, *source.pixels.shape[1::-1])
    axial_depth = _axial_depth(geometry, projection, source.pixels.shape[1::-1])
    carried: list[CarriedLayer] = []
    for each, pixels in zip(sources_by_file[0], warped, strict=True):
        record = record_of(paths[0], each)
        if each.kind != "depth":
            carried.append(CarriedLayer(each.name, each.kind, each.channels, pixels, record))
            continue
        depth = (pixels * axial_depth[..., None]).astype(np.float32)
        carried.append(CarriedLayer(each.name, each.kind, each.channels, depth, record))
        layer = each.channels[0].rpartition(".")[0] or each.name
        name, channel = f"{each.name}.{DISTANCE}", f"{layer}.{DISTANCE}"
        record = {**record, "layer": name, "channels": [channel]}
        carried.append(CarriedLayer(name, each.kind, (channel,), pixels, record))
    return CarriedLayers(tuple(carried), valid, attributes_of(sources_by_file[0]))


def file_size(panorama: Panorama, files: int) -> tuple[int, int]:
    """Return the width and height in px of each file, for a panorama in that many files."""
    if isinstance(panorama, LatitudeLongitude):
        return panorama.width, panorama.height
    assert isinstance(panorama, Views)
    first = panorama.views[0]
    return first.width, first.height * len(panorama.views) // files


def _axial_depth(geometry: Geometry | None, projection: Projection, size: tuple[int, int]) -> Array:
    """Return the depth of a point at distance 1 from the camera: (height, width)."""
    assert isinstance(geometry, Composition)
    columns, rows = geometry.size(*size)
    y, x = np.mgrid[:rows, :columns] + 0.5
    after_projection = Composition(geometry.parts[1:])
    x, y = after_projection.origins(x, y, *projection.size(*size))
    return np.nan_to_num(projection.lens.rays(x, y)[2])
