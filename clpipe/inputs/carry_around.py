"""Layers that go along with a picture of a panorama: put into one image, and moved."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from clpipe.base.errors import ImageError
from clpipe.base.types import Array
from clpipe.chain.carry import AovSpec
from clpipe.chain.chain import Chain
from clpipe.chain.panorama import projection_of
from clpipe.images.passes import cryptomatte_attributes
from clpipe.images.pixels import display_window
from clpipe.images.read import SourceImage
from clpipe.inputs.around import pieces
from clpipe.inputs.carry import Aov, Aovs, geometry_of, read_found, record_of
from clpipe.inputs.companions import find_all
from clpipe.reference.carried import Layer, warp
from clpipe.reference.geometry import Composition, Geometry
from clpipe.reference.panorama import LatitudeLongitude, Panorama, Views
from clpipe.reference.projection import Projection

DISTANCE = "Distance"


def carry_around(
    paths: Sequence[Path],
    source: SourceImage,
    chain: Chain,
    layers: Sequence[AovSpec],
    max_pixels: int,
    orientation: int = 1,
) -> Aovs:
    """The layers of a panorama that go along with its picture.

    Depth along the axes of views becomes depth along that of the picture, which is 0 and below
    beside and behind the camera; with it goes the distance, as a channel "Distance". The depth of a
    map is distance already. Normals are those of the world, and stay.

    Args:
        paths: the files.
        source: the image, an atlas.
        chain: what moves its pixels.
        layers: which.
        max_pixels: a file that claims more is refused before memory is taken.
        orientation: EXIF's, by which the picture is turned in the end.

    Raises:
        ImageError: as :func:`clpipe.inputs.carry.carry`, or the files' layers differ.
    """
    panorama, projection = source.panorama, projection_of(chain)
    assert panorama
    assert projection
    of_files = [find_all(path, layers) for path in paths]
    names = [[(each.name, each.kind, each.channels) for each in found] for found in of_files]
    for path, own in zip(paths, names, strict=True):
        if own != names[0]:
            raise ImageError(f"{path}: its layers are not those of {paths[0]}; render all alike")
    size = file_size(panorama, len(paths))
    read = []
    for same in zip(*of_files, strict=True):
        images: list[Array] = []
        for path, each in zip(paths, same, strict=True):
            pixels, place = read_found(each, path, size, max_pixels)
            images += pieces(panorama, display_window(pixels, *place, *size))
        first = same[0]
        if first.kind == "depth" and isinstance(panorama, Views):
            images = [
                (image * view.lengths()[..., None]).astype(np.float32)
                for image, view in zip(images, panorama.views, strict=True)
            ]
        filter_ = {"label": "nearest", "flow": ""}.get(first.kind, "linear")
        read.append(Layer(first.kind, panorama.atlas(images, filter_), vectors=first.vectors))
    geometry = geometry_of(chain, orientation)
    moved, valid = warp(read, geometry, *source.pixels.shape[1::-1])
    ahead = _ahead(geometry, projection, source.pixels.shape[1::-1])
    carried: list[Aov] = []
    for each, pixels in zip(of_files[0], moved, strict=True):
        record = record_of(paths[0], each)
        if each.kind != "depth":
            carried.append(Aov(each.name, each.kind, each.channels, pixels, record))
            continue
        along = (pixels * ahead[..., None]).astype(np.float32)
        carried.append(Aov(each.name, each.kind, each.channels, along, record))
        layer = each.channels[0].rpartition(".")[0] or each.name
        name, channel = f"{each.name}.{DISTANCE}", f"{layer}.{DISTANCE}"
        record = {**record, "layer": name, "channels": [channel]}
        carried.append(Aov(name, each.kind, (channel,), pixels, record))
    attributes: dict[str, str] = {}
    for each in of_files[0]:
        attributes |= cryptomatte_attributes(each.file, each.location.part)
    return Aovs(tuple(carried), valid, attributes)


def file_size(panorama: Panorama, files: int) -> tuple[int, int]:
    """The width and height of each of so many files of a panorama."""
    if isinstance(panorama, LatitudeLongitude):
        return panorama.width, panorama.height
    assert isinstance(panorama, Views)
    first = panorama.views[0]
    return first.width, first.height * len(panorama.views) // files


def _ahead(geometry: Geometry | None, projection: Projection, size: tuple[int, int]) -> Array:
    """(height, width): the depth of what is 1 away from the camera, for each pixel."""
    assert isinstance(geometry, Composition)
    columns, rows = geometry.size(*size)
    y, x = np.mgrid[:rows, :columns] + 0.5
    rest = Composition(geometry.parts[1:])
    x, y = rest.origins(x, y, *projection.size(*size))
    return np.nan_to_num(projection.lens.rays(x, y)[2])
