"""TODO."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from clpipe.base.errors import ImageError, KindError
from clpipe.base.text import printable
from clpipe.images.tags import _attributes

# Layers that hold the finished picture, in order of preference: no layer, then common names.
PICTURE_LAYERS = ("", "combined", "beauty", "rgba", "rgb", "color", "default")


@dataclass(frozen=True)
class _Picture:
    """Where in a file the picture is: the part, the layer as it is called, the channels."""

    part: int
    layer: str
    channels: tuple[int, ...]
    xyz: bool = False

    @property
    def rank(self) -> tuple[bool, int, int, str]:
        """Pictures in order of preference: colour, then a known name, then as in the file."""
        known = self.layer.lower().rpartition(".")[2]
        names = [*PICTURE_LAYERS, known]
        return len(self.channels) < 3, names.index(known), self.part, self.layer


def _find_picture(path: Path, file: Any, mosaic: bool, layer: str | None) -> _Picture:
    """The picture of a file, which is then at its part.

    Raises:
        ImageError: there is none, or it is of a kind that cannot be read.
    """
    found: list[str] = []
    pictures: list[_Picture] = []
    refusals: list[str] = []
    several = file.seek_subimage(1, 0)
    part = 0
    while file.seek_subimage(part, 0):
        spec = file.spec()
        part += 1
        if refusal := _no_picture(spec, file.seek_subimage(part - 1, 1)):
            refusals.append(refusal)
            continue
        names = list(spec.channelnames)
        found += [name for name in names if name not in found]
        kept = "kind" in _attributes(spec)
        called = str(spec.getattribute("oiio:subimagename") or "") if several else ""
        if mosaic:
            channel = mosaic_channel(names)
            here = [_Picture(part - 1, *channel)] if channel else []
        else:
            here = [
                _Picture(part - 1, _joined(called, own), channels, xyz)
                for own, channels, xyz in _layers(names, kept)
            ]
        if kept and not here:
            raise KindError(path, _attributes(spec))
        pictures += here
    if layer is not None and pictures:
        named = [p for p in pictures if p.layer.lower() == layer.lower()]
        if not named:
            listed = ", ".join(dict.fromkeys(p.layer or "one without a name" for p in pictures))
            raise ImageError(
                f"{path}: no layer {layer!r} with a picture; its layers: {printable(listed)}"
            )
        pictures = named
    if not pictures and refusals:
        raise ImageError(f"{path}: {refusals[0]}")
    if not pictures:
        listed = ", ".join(name for name in found[:20] if name) or "none"
        wanted = "no single channel with a mosaic" if mosaic else "no R, G and B channels"
        raise ImageError(f"{path}: {wanted}; found {printable(listed)}")
    best = min(pictures, key=lambda picture: picture.rank)
    file.seek_subimage(best.part, 0)
    file.geterror()  # of parts and levels that were looked for and are not there
    return best


def _no_picture(spec: Any, has_levels: bool) -> str:
    """Why a part is no picture, whatever its channels; "" where it may be one."""
    if spec.deep:
        return "a deep image (many samples a pixel); flatten it in the renderer first"
    if "CubeFace" in str(spec.getattribute("textureformat")):
        return "a cube map, not a picture"
    return "a texture (one image in several sizes), not a picture" if has_levels else ""


def _joined(part: str, layer: str) -> str:
    """A layer's name with its part's, unless it begins with that.

    >>> _joined("left", ""), _joined("left", "beauty"), _joined("View", "View.Combined")
    ('left', 'left.beauty', 'View.Combined')
    """
    if f"{layer}.".startswith(f"{part}."):
        return layer
    return f"{part}.{layer}" if part and layer else part or layer


def _layers(names: Sequence[str], kept: bool) -> Iterator[tuple[str, tuple[int, ...], bool]]:
    """The layers that can be a picture: their names, channels, and whether those are X, Y and Z.

    Only a layer without a name is a picture in X, Y and Z; others are positions and normals. Only
    one that has nothing beside it is luminance, and none that clpipe kept is.
    """
    for layer in dict.fromkeys(name.rpartition(".")[0] for name in names):
        place = {
            name.rpartition(".")[2].lower(): i
            for i, name in enumerate(names)
            if name.rpartition(".")[0].lower() == layer.lower()
        }
        here = set(place)
        if here >= set("rgb"):
            wanted = "rgb"
        elif not kept and not layer and here - {"a"} == set("xyz"):
            wanted = "xyz"
        elif not kept and here - {"a", "z"} == {"y"}:
            wanted = "y"
        else:
            continue
        yield layer, tuple(place[c] for c in wanted), wanted == "xyz"


def mosaic_channel(names: Sequence[str]) -> tuple[str, tuple[int]] | None:
    """The only channel that is neither alpha nor depth.

    >>> mosaic_channel(["Raw"]), mosaic_channel(["A", "Y"]), mosaic_channel(["X", "Y"])
    (('', (0,)), ('', (1,)), None)
    """
    places = [i for i, name in enumerate(names) if len(names) == 1 or name not in ("A", "Z")]
    return ("", (places[0],)) if len(places) == 1 else None


def picture_channels(names: Sequence[str]) -> tuple[str, tuple[int, ...]] | None:
    """The layer that holds the picture, and where its R, G and B stand among the channels.

    >>> picture_channels(["View.Depth.Z", "View.Combined.B", "View.Combined.G", "View.Combined.R"])
    ('View.Combined', (3, 2, 1))
    """
    pictures = [_Picture(0, *layer) for layer in _layers(names, kept=True)]
    best = min(pictures, key=lambda picture: picture.rank, default=None)
    return (best.layer, best.channels) if best else None
