"""Parts, layers and channels: where in a file the picture is."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from clpipe.base.errors import ImageError, KindError, NoPictureError
from clpipe.base.text import printable
from clpipe.images.attributes import own_attributes

# Layers that hold the finished picture, in order of preference: without a name, then common names.
PICTURE_LAYERS = ("", "combined", "beauty", "rgba", "rgb", "color", "default")

MOST_PARTS = 1000  # each takes as long as there are parts before it


@dataclass(frozen=True)
class PictureLocation:
    """Where in a file a picture is: the part's number, the layer's name, the channels' numbers.

    The channels are R, G and B, or X, Y and Z where ``xyz`` is set, or one alone.
    """

    part: int
    layer: str
    channels: tuple[int, ...]
    xyz: bool = False

    @property
    def rank(self) -> tuple[bool, int, int, str]:
        """The order of preference: colour first, then common names, then places in the file."""
        name = self.layer.lower().rpartition(".")[2]
        names = [*PICTURE_LAYERS, name]
        return len(self.channels) < 3, names.index(name), self.part, self.layer


def find_picture(path: Path, file: Any, mosaic: bool, layer: str | None) -> PictureLocation:
    """Find the picture of a file, and move the file to the picture's part.

    Args:
        path: the file, for messages.
        file: an open ``oiio.ImageInput``.
        mosaic: look for a single channel instead of a picture.
        layer: the layer that holds the picture; None chooses by :data:`PICTURE_LAYERS`.

    Raises:
        NoPictureError: there is no such picture.
        ImageError: the layer is missing, or the file holds another kind of image.
    """
    pictures: list[PictureLocation] = []
    channel_names: list[str] = []
    refusals: list[str] = []
    several_parts = file.seek_subimage(1, 0)
    part = 0
    while file.seek_subimage(part, 0):
        spec = file.spec()
        part += 1
        if part > MOST_PARTS:
            raise ImageError(f"{path}: has more than {MOST_PARTS} parts")
        if refusal := _refusal(spec, has_levels=file.seek_subimage(part - 1, 1)):
            refusals.append(refusal)
            continue
        names = list(spec.channelnames)
        channel_names += [name for name in names if name not in channel_names]
        kept = "kind" in own_attributes(spec)
        part_name = str(spec.getattribute("oiio:subimagename") or "") if several_parts else ""
        if mosaic:
            channel = mosaic_channel(names)
            in_part = [PictureLocation(part - 1, *channel)] if channel else []
        else:
            in_part = [
                PictureLocation(part - 1, full_name(part_name, own_name), channels, xyz)
                for own_name, channels, xyz in _layers(names, kept)
            ]
        if kept and not in_part:
            raise KindError(path, own_attributes(spec))
        pictures += in_part
    if layer is not None and pictures:
        pictures = _of_layer(path, pictures, layer)
    if not pictures and refusals:
        raise ImageError(f"{path}: {refusals[0]}")
    if not pictures:
        listed = ", ".join(name for name in channel_names[:20] if name) or "none"
        missing = "no single channel with a mosaic" if mosaic else "no R, G and B channels"
        raise NoPictureError(f"{path}: {missing}; found {printable(listed)}")
    best = min(pictures, key=lambda picture: picture.rank)
    file.seek_subimage(best.part, 0)
    file.geterror()  # clears it: the loop asked for parts and levels that do not exist
    return best


def _of_layer(path: Path, pictures: list[PictureLocation], layer: str) -> list[PictureLocation]:
    """The pictures in a layer of this name, in any case.

    Raises:
        ImageError: there is none.
    """
    named = [picture for picture in pictures if picture.layer.lower() == layer.lower()]
    if not named:
        listed = ", ".join(dict.fromkeys(p.layer or "one without a name" for p in pictures))
        raise ImageError(
            f"{path}: no layer {layer!r} with a picture; its layers: {printable(listed)}"
        )
    return named


def _refusal(spec: Any, has_levels: bool) -> str:
    """Why a part is not a picture, whatever its channels are called; "" where it may be one."""
    if spec.deep:
        return "a deep image (many samples a pixel); flatten it in the renderer first"
    return "a texture (one image in several sizes), not a picture" if has_levels else ""


def full_name(part: str, layer: str) -> str:
    """A layer's name with its part's name before it, unless it already begins with that.

    >>> full_name("left", ""), full_name("left", "beauty"), full_name("View", "View.Combined")
    ('left', 'left.beauty', 'View.Combined')
    """
    if f"{layer}.".startswith(f"{part}."):
        return layer
    return f"{part}.{layer}" if part and layer else part or layer


def _layers(names: Sequence[str], kept: bool) -> Iterator[tuple[str, tuple[int, ...], bool]]:
    """The layers that can be a picture: name, channels, and whether these are X, Y and Z.

    X, Y and Z are a picture only in a layer without a name; in others they are positions or
    normals. Y is luminance only where nothing but alpha and depth is beside it. ``kept`` images,
    those that clpipe wrote, have neither.
    """
    for layer in dict.fromkeys(name.rpartition(".")[0] for name in names):
        place = {
            name.rpartition(".")[2].lower(): i
            for i, name in enumerate(names)
            if name.rpartition(".")[0].lower() == layer.lower()
        }
        channels = set(place)
        if channels >= set("rgb"):
            colours = "rgb"
        elif not kept and not layer and channels - {"a"} == set("xyz"):
            colours = "xyz"
        elif not kept and channels - {"a", "z"} == {"y"}:
            colours = "y"
        else:
            continue
        yield layer, tuple(place[c] for c in colours), colours == "xyz"


def mosaic_channel(names: Sequence[str]) -> tuple[str, tuple[int]] | None:
    """The layer ("") and number of the only channel that is neither alpha nor depth.

    >>> mosaic_channel(["Raw"]), mosaic_channel(["A", "Y"]), mosaic_channel(["X", "Y"])
    (('', (0,)), ('', (1,)), None)
    """
    places = [i for i, name in enumerate(names) if len(names) == 1 or name not in ("A", "Z")]
    return ("", (places[0],)) if len(places) == 1 else None


def picture_channels(names: Sequence[str]) -> tuple[str, tuple[int, ...]] | None:
    """The layer that holds the picture, and the numbers of its R, G and B; None without one.

    >>> picture_channels(["View.Depth.Z", "View.Combined.B", "View.Combined.G", "View.Combined.R"])
    ('View.Combined', (3, 2, 1))
    """
    pictures = [PictureLocation(0, *layer) for layer in _layers(names, kept=True)]
    best = min(pictures, key=lambda picture: picture.rank, default=None)
    return (best.layer, best.channels) if best else None
