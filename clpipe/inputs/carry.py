"""Carried layers: read from a render's file or its companions, and warped like its pixels."""

import os
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from clpipe.base.digests import digests, stamp_of
from clpipe.base.errors import ImageError, RequestError
from clpipe.base.reading import check_unchanged
from clpipe.base.types import Array
from clpipe.chain.carry import AovSpec
from clpipe.chain.chain import Chain
from clpipe.images.passes import cryptomatte_attributes, read_layer
from clpipe.images.read import SourceImage
from clpipe.images.tags import FLIPS
from clpipe.inputs.carry_rows import combine_rows, files_by_row, row_step
from clpipe.inputs.companions import LayerSource, find_carried_layers
from clpipe.inputs.layer_values import value_warnings
from clpipe.reference.carried import RESAMPLING, Layer, LayerKind, between_rows, warp
from clpipe.reference.geometry import Composition, Geometry, Margins, Orientation


@dataclass(frozen=True)
class CarriedLayer:
    """A carried layer: a render pass (AOV) that was warped like its picture.

    Args:
        name: its name in ``--carry``.
        kind: the meaning of its values, such as depth; it decides how the layer is resampled.
        channels: the full names of its channels, each with the layer's name.
        pixels: (height, width, channel), with the picture's height and width.
        record: its entry in a sidecar: its file, and how it was resampled.
    """

    name: str
    kind: LayerKind
    channels: tuple[str, ...]
    pixels: Array
    record: Mapping[str, Any]


@dataclass(frozen=True)
class CarriedLayers:
    """All carried layers of a picture.

    Args:
        layers: the layers, in the order of ``--carry``.
        valid: (height, width): 1 where all layers are known, otherwise 0.
        attributes: EXR attributes of the layers, such as the names of a Cryptomatte's objects.
        other_records: entries in a sidecar of further files that the layers are made of.
        warnings: sentences about values that cannot mean what their kind says.
    """

    layers: tuple[CarriedLayer, ...]
    valid: Array
    attributes: Mapping[str, str]
    other_records: tuple[Mapping[str, Any], ...] = ()
    warnings: tuple[str, ...] = ()

    @property
    def records(self) -> list[Mapping[str, Any]]:
        """The entries of the layers in a sidecar."""
        return [*(layer.record for layer in self.layers), *self.other_records]

    def map_arrays(self, change: Callable[[Array], Array]) -> "CarriedLayers":
        """Return the layers with a function applied to each array, such as a crop."""
        layers = (replace(layer, pixels=change(layer.pixels)) for layer in self.layers)
        return replace(self, layers=tuple(layers), valid=change(self.valid))

    def check_no_vectors(self) -> None:
        """Check that no layer contains vectors, which flips and rotations would have to change.

        Raises:
            RequestError: a layer contains vectors.
        """
        for layer in self.layers:
            if layer.kind in ("normal", "flow"):
                raise RequestError(
                    f"--carry {layer.name}: augment flips and rotates patches, but cannot rotate "
                    f"the vectors in a layer of {layer.kind}; omit augment or this layer"
                )

    def arrays(self) -> dict[str, Array]:
        """Return each layer by its name, (height, width, channel); a Cryptomatte is one array."""
        names = dict.fromkeys(layer.name for layer in self.layers)
        return {
            name: np.concatenate([each.pixels for each in self.layers if each.name == name], -1)
            for name in names
        }


def carry(
    paths: Sequence[Path],
    source: SourceImage,
    chain: Chain,
    layers: Sequence[AovSpec],
    max_pixels: int,
    orientation: int = 1,
) -> CarriedLayers:
    """Return the layers of an image, warped like its picture.

    Args:
        paths: the image file; or all files of a rolling shutter's exposure, if each row of the
            layers is from the file in the middle of its exposure. Flow then leads to the row of the
            other frame in which the surface is seen.
        source: the image.
        chain: the chain whose stages move pixels.
        layers: the layers to carry.
        max_pixels: a file with more pixels is rejected before it is read.
        orientation: the EXIF orientation that is applied to the picture at the end. Normals keep
            their directions.

    Raises:
        ImageError: a layer or companion is missing or damaged, differs from the image in size, or
            its kind is unknown. Or the files have different layers.
        RequestError: the time between frames is not known, but flow leads between rows.
    """
    size = source.pixels.shape[1::-1]
    by_row = files_by_row(chain, len(paths), size[1], source.margins)
    used = {number: paths[number] for number in np.unique(by_row).tolist()}
    sources_by_file = find_same_layers([*used.values()], layers, source.layer)
    read: list[Layer] = []
    warnings: list[str] = []
    for matching in zip(*sources_by_file, strict=True):
        parts = {
            number: read_source(each, used[number], source.margins, size, max_pixels)
            for number, each in zip(used, matching, strict=True)
        }
        warnings += warnings_of(matching[0], parts[min(parts)])
        layer = combine_rows(parts, by_row)
        if layer.vectors and len(paths) > 1:
            layer = between_rows(layer, matching[0].directions, row_step(chain))
        read.append(layer)
    warped, valid = warp(read, geometry_of(chain, orientation), *size)
    first, *others = (
        [record_of(path, each) for each in found]
        for path, found in zip(used.values(), sources_by_file, strict=True)
    )
    carried = tuple(
        CarriedLayer(each.name, each.kind, each.channels, pixels, record)
        for each, pixels, record in zip(sources_by_file[0], warped, first, strict=True)
    )
    other_records = tuple(record for records in others for record in records)
    attributes = attributes_of(sources_by_file[0])
    return CarriedLayers(carried, valid, attributes, other_records, tuple(warnings))


def warnings_of(source: LayerSource, layer: Layer) -> list[str]:
    """Return warnings about the values of a layer.

    Raises:
        ImageError: it is a Cryptomatte whose hashes are rounded.
    """
    try:
        return value_warnings(source.name, layer.kind, layer.pixels)
    except ImageError as error:
        raise ImageError(f"{source.file}: {error}") from None


def find_same_layers(
    paths: Sequence[Path], layers: Sequence[AovSpec], picture: str = ""
) -> list[list[LayerSource]]:
    """Return the carried layers of each file. All files have the same layers.

    Args:
        paths: the files.
        layers: the requested layers.
        picture: the name of the layer that contains the picture.

    Raises:
        ImageError: a layer is missing, or files have different layers.
    """
    sources_by_file = [find_carried_layers(path, layers, picture) for path in paths]
    names = [[(each.name, each.kind, each.channels) for each in found] for found in sources_by_file]
    for path, layer_names in zip(paths, names, strict=True):
        if layer_names != names[0]:
            raise ImageError(
                f"{path}: the layers of this file differ from those of {paths[0]}; render all "
                "files of one picture with the same layers"
            )
    return sources_by_file


def attributes_of(layers: Sequence[LayerSource]) -> dict[str, str]:
    """Return the EXR attributes of layers, such as the names of a Cryptomatte's objects."""
    attributes: dict[str, str] = {}
    for each in layers:
        attributes |= cryptomatte_attributes(each.file, each.location.part)
    return attributes


def read_source(
    layer: LayerSource, path: Path, margins: Margins, size: tuple[int, int], max_pixels: int
) -> Layer:
    """Return a layer at its place in an image with overscan.

    Args:
        layer: the layer.
        path: the image file.
        margins: the overscan of the image.
        size: width and height of the image with its overscan, in px.
        max_pixels: a file with more pixels is rejected before it is read.

    Raises:
        ImageError: as for :func:`read_layer_samples`.
    """
    pixels, (x, y) = read_layer_samples(layer, path, margins.frame_size(*size), max_pixels)
    return Layer(layer.kind, pixels, x + margins.left, y + margins.top, layer.vectors)


def read_layer_samples(
    layer: LayerSource, path: Path, size: tuple[int, int], max_pixels: int
) -> tuple[Array, tuple[int, int]]:
    """Return the samples of a layer, (row, column, channel), and the x and y of the first one.

    Args:
        layer: the layer.
        path: the image file.
        size: width and height of the image in px.
        max_pixels: a file with more pixels is rejected before it is read.

    Raises:
        ImageError: the layer is damaged, or differs from the image in size.
    """
    with check_unchanged(layer.file):
        pixels, place, layer_size = read_layer(layer.file, layer.location, max_pixels)
    if layer_size != size:
        raise ImageError(
            f"{layer.file}: its layer {layer.name} has {layer_size[0]}x{layer_size[1]} pixels, but "
            f"the picture {path} has {size[0]}x{size[1]}; render both at one size"
        )
    return pixels, place


def merge_moments(by_moment: Mapping[str, CarriedLayers], named: bool) -> CarriedLayers:
    """Return the layers of several moments of an exposure in one object.

    Args:
        by_moment: the layers, by the name of the moment.
        named: whether to prefix the names of layers and channels with the moment, unless it is
            the middle.
    """
    layers: list[CarriedLayer] = []
    for moment, carried_layers in by_moment.items():
        prefix = f"{moment}." if named and moment != "middle" else ""
        layers += [
            replace(
                each,
                name=f"{prefix}{each.name}",
                channels=tuple(f"{prefix}{channel}" for channel in each.channels),
                record={**each.record, "layer": f"{prefix}{each.name}", "moment": moment},
            )
            for each in carried_layers.layers
        ]
    first, *others = by_moment.values()
    valid = first.valid.copy()
    for other in others:
        valid *= other.valid
    warnings = dict.fromkeys(w for each in by_moment.values() for w in each.warnings)
    return replace(first, layers=tuple(layers), valid=valid, warnings=tuple(warnings))


def geometry_of(chain: Chain, orientation: int) -> Geometry | None:
    """Return how pixels move from an image to its upright picture; None if they do not move."""
    parts = chain.geometry.parts if chain.geometry else ()
    orientation_part = (Orientation(*FLIPS[orientation]),) if orientation != 1 else ()
    return Composition((*parts, *orientation_part)) if parts or orientation_part else None


def record_of(path: Path, layer: LayerSource) -> dict[str, Any]:
    """Return the entry of a carried layer in the sidecar of the image ``path``."""
    return {
        "layer": layer.name,
        "kind": layer.kind,
        "resampling": RESAMPLING[layer.kind],
        "channels": list(layer.channels),
        **file_record(path, layer.file),
    }


def file_record(path: Path, file: Path) -> dict[str, Any]:
    """Return the entry of a companion file in the sidecar of the image ``path``."""
    size, modified = stamp_of(file)
    sha256 = digests([str(file)]).get(str(file), "")
    name = os.path.relpath(file, path.parent)
    return {"file": name, "size": size, "modified": modified, "sha256": sha256}
