"""Layers that go along with a picture: found in its file or beside it, and moved as its pixels."""

import os
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from clpipe.base.digests import digests, stamp_of
from clpipe.base.errors import ImageError, RequestError
from clpipe.base.reading import unchanged
from clpipe.base.types import Array
from clpipe.chain.carry import AovSpec
from clpipe.chain.chain import Chain
from clpipe.images.passes import (
    cryptomatte_attributes,
    read_layer,
)
from clpipe.images.read import SourceImage
from clpipe.images.tags import FLIPS
from clpipe.inputs.companions import FoundLayer, find_all
from clpipe.reference.carried import RESAMPLING, Layer, LayerKind, warp
from clpipe.reference.geometry import Composition, Geometry, Orientation


@dataclass(frozen=True)
class Aov:
    """A layer as it goes along with a picture.

    Args:
        name: as it was asked for.
        kind: what it holds.
        channels: the names of its channels, with the layer's.
        pixels: (height, width, channel) as the picture is.
        record: what a sidecar says of it: where it is from, and how it was resampled.
    """

    name: str
    kind: LayerKind
    channels: tuple[str, ...]
    pixels: Array
    record: Mapping[str, Any]


@dataclass(frozen=True)
class Aovs:
    """All layers that go along with a picture.

    Args:
        layers: in the order in which they were asked for.
        valid: (height, width), 1 where all of them are known, else 0.
        attributes: what goes with them, such as the names of a Cryptomatte's objects.
    """

    layers: tuple[Aov, ...]
    valid: Array
    attributes: Mapping[str, str]

    def changed(self, change: Callable[[Array], Array]) -> "Aovs":
        """Layers whose pixels are changed, as those of a patch are cut out."""
        layers = (replace(layer, pixels=change(layer.pixels)) for layer in self.layers)
        return replace(self, layers=tuple(layers), valid=change(self.valid))

    def check_turns(self) -> None:
        """See that layers can be flipped and turned, which vectors are not by moving their pixels.

        Raises:
            RequestError: one holds vectors.
        """
        for layer in self.layers:
            if layer.kind in ("normal", "flow"):
                raise RequestError(
                    f"--carry {layer.name}: augment flips and turns patches, but not the "
                    f"directions that a layer of {layer.kind} holds; leave one of them out"
                )

    def arrays(self) -> dict[str, Array]:
        """The layers as they were asked for, (height, width, channel); a Cryptomatte's in one."""
        names = dict.fromkeys(layer.name for layer in self.layers)
        return {
            name: np.concatenate([each.pixels for each in self.layers if each.name == name], -1)
            for name in names
        }


def carry(
    path: Path,
    source: SourceImage,
    chain: Chain,
    layers: Sequence[AovSpec],
    max_pixels: int,
    orientation: int = 1,
) -> Aovs:
    """The layers of an image that go along with its picture.

    Args:
        path: of the image.
        source: the image.
        chain: what moves its pixels.
        layers: which.
        max_pixels: a file that claims more is refused before memory is taken.
        orientation: EXIF's, by which the picture is turned in the end; normals are not turned.

    Raises:
        ImageError: a layer or a companion is missing or damaged, is not as large as the image, or
            does not say what it holds.
    """
    whole = source.pixels.shape[1::-1]
    width, height = source.margins.inside(*whole)
    found = find_all(path, layers)
    read: list[Layer] = []
    attributes: dict[str, str] = {}
    for each in found:
        pixels, (x, y) = read_found(each, path, (width, height), max_pixels)
        attributes |= cryptomatte_attributes(each.file, each.location.part)
        x, y = x + source.margins.left, y + source.margins.top
        read.append(Layer(each.kind, pixels, x, y, each.vectors))
    moved, valid = warp(read, geometry_of(chain, orientation), *whole)
    carried = tuple(
        Aov(each.name, each.kind, each.channels, pixels, record_of(path, each))
        for each, pixels in zip(found, moved, strict=True)
    )
    return Aovs(carried, valid, attributes)


def read_found(
    layer: FoundLayer, path: Path, size: tuple[int, int], max_pixels: int
) -> tuple[Array, tuple[int, int]]:
    """The samples of a layer, (rows, columns, channel), and where the first of them is.

    Args:
        layer: the layer.
        path: of the image.
        size: of the image.
        max_pixels: a file that claims more is refused before memory is taken.

    Raises:
        ImageError: it is damaged, or of another size than the image.
    """
    with unchanged(layer.file):
        pixels, place, own = read_layer(layer.file, layer.location, max_pixels)
    if own != size:
        raise ImageError(
            f"{layer.file}: its layer {layer.name} has {own[0]}x{own[1]} pixels, but the "
            f"picture {path} has {size[0]}x{size[1]}; render both at one size"
        )
    return pixels, place


def joined(of_moments: Mapping[str, Aovs], named: bool) -> Aovs:
    """The layers of several moments of an exposure as those of one.

    Args:
        of_moments: by the names of the moments.
        named: whether names and channels say the moment, but for the middle's.
    """
    layers: list[Aov] = []
    for moment, own in of_moments.items():
        prefix = f"{moment}." if named and moment != "middle" else ""
        layers += [
            replace(
                each,
                name=f"{prefix}{each.name}",
                channels=tuple(f"{prefix}{channel}" for channel in each.channels),
                record={**each.record, "layer": f"{prefix}{each.name}", "moment": moment},
            )
            for each in own.layers
        ]
    first, *others = of_moments.values()
    valid = first.valid.copy()
    for other in others:
        valid *= other.valid
    return Aovs(tuple(layers), valid, first.attributes)


def geometry_of(chain: Chain, orientation: int) -> Geometry | None:
    """How the pixels of an image move on their way into a picture that is turned upright."""
    parts = chain.geometry.parts if chain.geometry else ()
    turned = (Orientation(*FLIPS[orientation]),) if orientation != 1 else ()
    return Composition((*parts, *turned)) if parts or turned else None


def record_of(path: Path, layer: FoundLayer) -> dict[str, Any]:
    """What the sidecar of the image ``path`` says of a layer that goes along."""
    return {
        "layer": layer.name,
        "kind": layer.kind,
        "resampling": RESAMPLING[layer.kind],
        "channels": list(layer.channels),
        **file_record(path, layer.file),
    }


def file_record(path: Path, file: Path) -> dict[str, Any]:
    """What the sidecar of the image ``path`` says of a file that belongs to it."""
    size, modified = stamp_of(file)
    sha256 = digests([str(file)]).get(str(file), "")
    name = os.path.relpath(file, path.parent)
    return {"file": name, "size": size, "modified": modified, "sha256": sha256}
