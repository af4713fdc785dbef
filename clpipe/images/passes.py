"""Finds and reads the layers of a render other than its picture: depth, normals, IDs, motion."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np
import OpenImageIO as oiio

from clpipe.base.cpu_time import CpuTimer
from clpipe.base.types import Array
from clpipe.images.clip_frames import clip_of, read_clip_samples
from clpipe.images.kinds import kind_from_name
from clpipe.images.layers import full_name, stated_views, view_of
from clpipe.images.openimageio import MAX_PARTS, open_image, parts_of
from clpipe.images.pixels import check_size
from clpipe.images.samples import read_samples
from clpipe.images.statements import read_statements
from clpipe.reference.carried import LayerKind

CRYPTOMATTE = "cryptomatte/"  # prefix of attributes that map Cryptomatte's numbers to names

CHANNEL_ORDER = "RGBAXYZWUV"  # order of the channels of a layer

FLOAT_TYPES = {oiio.HALF: oiio.HALF, oiio.FLOAT: oiio.FLOAT, oiio.DOUBLE: oiio.FLOAT}


@dataclass(frozen=True)
class LayerLocation:
    """The location of a layer in a file.

    Args:
        name: the name of the layer; "" for channels whose names have no layer.
        part: the number of its part.
        channels: the names of its channels, without the layer's.
        indices: their numbers in the part.
        type: the ``oiio.BASETYPE`` of its samples.
        view: the number of its view, in the order of the file's views.
        base: its name without the view.
    """

    name: str
    part: int
    channels: tuple[str, ...]
    indices: tuple[int, ...]
    type: Any
    view: int = 0
    base: str = ""

    @property
    def view_layer(self) -> str:
        """The name of the view layer that it belongs to: its name before the last part, or ""."""
        return self.base.rpartition(".")[0]

    @property
    def is_colour(self) -> bool:
        """Whether its channels are red, green and blue."""
        return {channel.upper() for channel in self.channels} >= set("RGB")

    def matches(self, name: str) -> bool:
        """Return whether a name is that of this layer, or the end of it, in any case.

        All ranks of a Cryptomatte match its name without a number. A single Z matches depth.
        """
        is_z = self.name.rpartition(".")[2] in ("Z", "z")
        names = [self.name, self.without_rank, *(["depth"] if is_z else [])]
        return any(f".{each}".lower().endswith(f".{name}".lower()) for each in names)

    @property
    def without_rank(self) -> str:
        """The name; for a layer of a Cryptomatte, without its number."""
        is_rank = "crypto" in self.name.lower() and self.name[-2:].isdigit()
        return self.name[:-2] if is_rank else self.name


def layer_kind(name: str, location: LayerLocation) -> LayerKind | None:
    """Return the kind of a layer, from its names and channels; None if it is not known."""
    if kind := kind_from_name(name) or kind_from_name(location.base):
        return kind
    if location.type not in FLOAT_TYPES:
        return "label"
    return "colour" if location.is_colour else None


def find_layers(path: Path) -> list[LayerLocation]:
    """Return all layers of a file in order. Layers without a name are its picture.

    Raises:
        ImageError: the file is missing, damaged or not an image.
    """
    found: list[LayerLocation] = []
    views: list[str] = []
    if clip_of(path):
        samples = read_clip_samples(path)
        channels = tuple("RGB") if samples.ndim == 3 else ("Y",)
        return [LayerLocation("", 0, channels, tuple(range(len(channels))), oiio.UINT16)]
    with open_image(path) as file:
        for part, part_name, spec in islice(parts_of(file), MAX_PARTS):
            if not spec.deep:
                views += stated_views(spec)
                found += _layers_in(part, part_name, spec)
    named = ((each, view_of(each.name, views)) for each in found)
    return [replace(each, view=view, base=base) for each, (view, base) in named]


def _layers_in(part: int, part_name: str, spec: Any) -> Iterator[LayerLocation]:
    """Yield the layers of one part."""
    types = spec.channelformats or [spec.format] * spec.nchannels
    views = stated_views(spec)
    for name, indices in _group_channels(spec.channelnames, bool(part_name), views).items():
        names = {i: spec.channelnames[i].rpartition(".")[2] for i in indices}
        order = sorted(indices, key=lambda i: (CHANNEL_ORDER.find(names[i].upper()), names[i]))
        basetypes = {types[i].basetype for i in indices}
        type_ = basetypes.pop() if len(basetypes) == 1 else oiio.FLOAT
        channels = tuple(names[i] for i in order)
        yield LayerLocation(full_name(part_name, name), part, channels, tuple(order), type_)


def _group_channels(
    names: Sequence[str], in_part: bool = False, views: Sequence[str] = ()
) -> Mapping[str, list[int]]:
    """Return the numbers of channels by layer.

    Colour channels and vector components without a layer form the layer "". Any other channel
    without a layer is a layer of its own. In a file of several parts, this requires that the part
    has R, G and B as well. The same applies to the channels of a view.

    >>> _group_channels(["R", "G", "B", "A", "Z", "id", "Normal.X"])
    {'': [0, 1, 2, 3], 'Z': [4], 'id': [5], 'Normal': [6]}
    >>> _group_channels(["X", "Y", "Z"]), _group_channels(["Z"])
    ({'': [0, 1, 2]}, {'Z': [0]})
    >>> _group_channels(["right.R", "right.G", "right.B", "right.Z"], views=["left", "right"])
    {'right': [0, 1, 2], 'right.Z': [3]}
    >>> _group_channels(["Z"], in_part=True)
    {'': [0]}
    """
    bare = {name.upper() for name in names if "." not in name}
    vectors = ("RGBA", "XYZW", "XY", "UV", *([bare] if in_part else []))
    vector = next((each for each in vectors if set(list(each)[:3]) <= bare), ())
    groups: dict[str, list[int]] = {}
    for i, name in enumerate(names):
        layer, dot, channel = name.rpartition(".")
        group = layer if dot or channel.upper() in vector else channel
        if layer in views and channel.upper() not in "RGBA":
            group = name
        groups.setdefault(group, []).append(i)
    return groups


@CpuTimer("decode")
def read_layer(
    path: Path, location: LayerLocation, max_pixels: int
) -> tuple[Array, tuple[int, int], tuple[int, int]]:
    """Read a layer of a file as stored: half, float32, or whole numbers as uint32.

    Args:
        path: the file.
        location: the location of the layer.
        max_pixels: a file with more pixels is rejected before it is read.

    Returns:
        The samples of the data window, (rows, columns, channel); column and row of the first one in
        the display window; and the display window's width and height.

    Raises:
        ImageError: the file is damaged or too large.
    """
    if clip_of(path):
        samples = read_clip_samples(path)
        height, width = samples.shape[:2]
        check_size(path, width, height, max_pixels)
        return samples.reshape(height, width, -1).astype(np.uint32), (0, 0), (width, height)
    with open_image(path) as file:
        file.seek_subimage(location.part, 0)
        spec = file.spec()
        width, height = spec.full_width, spec.full_height
        check_size(path, width, height, max_pixels)
        check_size(path, spec.width, spec.height, max_pixels)
        # OpenImageIO would scale whole numbers that are read as floats.
        type_ = FLOAT_TYPES.get(location.type, location.type)
        pixels = read_samples(path, file, location.part, location.indices, type_)
        if pixels.dtype.kind != "f":
            pixels = pixels.astype(np.uint32)
        stated = read_statements(path, file)
        if stated.orientation != 1:  # such files have no data window
            upright = stated.upright(pixels)
            return upright, (0, 0), (upright.shape[1], upright.shape[0])
        return (
            np.ascontiguousarray(pixels),
            (spec.x - spec.full_x, spec.y - spec.full_y),
            (width, height),
        )


def cryptomatte_attributes(path: Path, part: int) -> dict[str, str]:
    """Return the attributes of a part that describe its Cryptomatte layers.

    Raises:
        ImageError: the file is damaged.
    """
    if clip_of(path):
        return {}
    with open_image(path) as file:
        file.seek_subimage(part, 0)
        listed = file.spec().extra_attribs
        return {a.name: str(a.value) for a in listed if a.name.startswith(CRYPTOMATTE)}
