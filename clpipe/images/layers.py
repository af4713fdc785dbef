"""Finds the picture of a file among its parts, layers and channels."""

import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from clpipe.base.errors import ImageError, KindError, NoPictureError
from clpipe.base.text import printable
from clpipe.images.attributes import clpipe_attributes
from clpipe.images.kinds import is_aov
from clpipe.images.openimageio import MAX_PARTS, parts_of
from clpipe.images.spectral import SPECTRAL, Spectrum, light_in, spectra_in

# Names of layers that hold the finished picture, in order of preference, in lower-case letters. The
# first are channels R, G and B without a layer: Nuke, Arnold, V-Ray, Mitsuba, Octane, Unreal.
PICTURE_LAYERS = (
    "",
    "composite.combined",  # Blender, after its compositor
    "combined",  # Blender
    *("rgbimagepipeline", "rgbaimagepipeline"),  # LuxCore
    "ci",  # RenderMan
    "c",  # Houdini
    "beauty",  # Arnold, V-Ray, Octane, Karma
    "finalimage",  # Unreal
    *("rgba", "rgb"),  # Arnold, Nuke, LuxCore
    *("effectsresult", "rgbcolor"),  # V-Ray
    *("main", "image", "color", "colour", "default"),
)
GENERIC_NAMES = (
    "rgba",
    "rgb",
    "color",
    "colour",
    "default",
    "main",
    "image",
)  # in layers of any kind


@dataclass(frozen=True)
class PictureLocation:
    """The location of a picture in a file.

    Args:
        part: the number of the part.
        layer: the name of the layer.
        channels: the numbers of R, G and B, of X, Y and Z, or of a single channel.
        xyz: whether the channels are X, Y and Z.
        view: the number of the view in a stereo picture.
        name: the name of the layer, without the view's name.
        wavelengths: of the bands of a spectral picture, nm; its channels are these bands.
        unread: spectra in the file that are not this picture.
    """

    part: int
    layer: str
    channels: tuple[int, ...]
    xyz: bool = False
    view: int = 0
    name: str = ""
    wavelengths: tuple[float, ...] = ()
    unread: tuple[Spectrum, ...] = ()

    @property
    def rank(self) -> tuple[bool, int, int]:
        """A sort key: colour first, then known names, then views."""
        *above, last = (re.sub(r"[^a-z0-9]", "", part) for part in self.name.lower().split("."))
        candidates = (f"{above[-1] if above else ''}.{last}", last)
        places = [PICTURE_LAYERS.index(each) for each in candidates if each in PICTURE_LAYERS]
        return len(self.channels) < 3, min(places, default=len(PICTURE_LAYERS)), self.view

    @property
    def is_aov(self) -> bool:
        """Whether its name is the name of an AOV."""
        if not self.name:
            return False
        *above, last = self.name.split(".")
        return is_aov(last) or (last.lower() in GENERIC_NAMES and any(map(is_aov, above)))


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
    rejections: list[str] = []
    views: list[str] = []
    spectra: list[Spectrum] = []
    for part, part_name, spec in parts_of(file):
        if part >= MAX_PARTS:
            raise ImageError(
                f"{path}: this file has more than {MAX_PARTS} parts; split it into several files"
            )
        if rejection := _rejection(spec, has_levels=file.seek_subimage(part, 1)):
            rejections.append(rejection)
            continue
        names = list(spec.channelnames)
        channel_names += [name for name in names if name not in channel_names]
        is_kept = "kind" in clpipe_attributes(spec)
        views += stated_views(spec)
        channel = mosaic_channel(names) if mosaic else None
        for spectrum in () if mosaic else spectra_in(names):
            full = full_name(part_name, spectrum.layer)
            rejections += (problem := _integer_problem(spec, full, spectrum.channels))
            if not problem:
                view, name = view_of(full, views)
                spectra.append(replace(spectrum, layer=full, part=part, view=view, name=name))
        found = [] if mosaic else list(_layers(names, is_kept))
        if is_kept and not (found or channel):
            raise KindError(path, clpipe_attributes(spec))
        pictures += [PictureLocation(part, *channel)] if channel else []
        for layer_name, channels, xyz in found:
            full = full_name(part_name, layer_name)
            rejections += (problem := _integer_problem(spec, full, channels))
            if not problem:
                view, name = view_of(full, views)
                pictures.append(PictureLocation(part, full, channels, xyz, view, name))
    if not pictures and rejections:
        raise ImageError(f"{path}: {rejections[0]}")
    if chosen := spectra_to_read(layer, spectra, pictures):
        best = PictureLocation(**vars(light_in(path, chosen, layer)))
    elif not pictures:
        raise _no_picture(path, layer, spectra, channel_names, mosaic)
    else:
        named = layer is not None and _picture_in_layer(path, pictures, layer)
        best = replace(named or _preferred(path, pictures), unread=tuple(spectra))
    file.seek_subimage(best.part, 0)
    file.geterror()  # clears the error: the loop asked for levels that do not exist
    return best


def spectra_to_read(
    layer: str | None, spectra: Sequence[Spectrum], pictures: Sequence[PictureLocation]
) -> list[Spectrum]:
    """Return the spectra of a file among which the light is; [] if its picture is read."""
    if layer is None:
        has_colours = any(len(each.channels) == 3 and not each.is_aov for each in pictures)
        return [] if has_colours else [*spectra]
    if layer.lower() == SPECTRAL:
        return [*spectra]
    is_picture = any(each.layer.lower() == layer.lower() for each in pictures)
    return [] if is_picture else [each for each in spectra if each.is_in(layer)]


def _no_picture(
    path: Path,
    layer: str | None,
    spectra: Sequence[Spectrum],
    channel_names: Sequence[str],
    mosaic: bool,
) -> ImageError:
    """Return the error for a file without a picture."""
    if spectra:
        return ImageError(
            f"{path}: there is no layer {layer!r}, but {' and '.join(map(str, spectra))}; name one "
            "of them with --layer, or remove --layer"
        )
    listed = ", ".join(name for name in channel_names[:20] if name) or "none"
    missing = "several channels, but a mosaic has one" if mosaic else "no R, G and B channels"
    advice = "" if mosaic else "To use its layers as ground truth of a picture, see --carry"
    return NoPictureError(f"{path}: there are {missing}; found {printable(listed)}", advice)


def stated_views(spec: Any) -> list[str]:
    """Return the names of the views that a part states, an ``oiio.ImageSpec``."""
    stated = spec.getattribute("view") or spec.getattribute("multiView") or ()
    return [stated] if isinstance(stated, str) else [str(each) for each in stated]


def view_of(name: str, views: Sequence[str]) -> tuple[int, str]:
    """Return the number of a layer's view, 0 if it has none, and the layer's name without it.

    >>> view_of("rgba_right", ["left", "right"]), view_of("beauty.left", ["left"])
    ((1, 'rgba'), (0, 'beauty'))
    >>> view_of("right.Z", ["left", "right"])
    (1, 'Z')
    """
    for number, view in enumerate(dict.fromkeys(views)):
        if name == view or (view and name.endswith((f".{view}", f"_{view}"))):
            return number, name[: -len(view)].rstrip("._")
        if view and name.startswith(f"{view}."):
            return number, name.removeprefix(f"{view}.")
    return 0, name


def _integer_problem(spec: Any, layer: str, channels: Sequence[int]) -> list[str]:
    """Return why channels of an OpenEXR file are IDs instead of light; [] if they may be light."""
    formats = spec.channelformats or [spec.format] * spec.nchannels
    types = dict.fromkeys(str(formats[i]) for i in channels)
    if "uint" not in types or spec.getattribute("openexr:lineOrder") is None:
        return []
    name = f"layer {printable(layer)}" if layer else "its picture"
    return [
        f"{name} has channels of type {' and '.join(types)}. Channels of type uint hold IDs or "
        "masks, not light. A picture has channels of type half or float; this file has no others"
    ]


def _preferred(path: Path, pictures: Sequence[PictureLocation]) -> PictureLocation:
    """Return the preferred picture among the layers that may be one.

    Raises:
        NoPictureError: all layers are AOVs by their names.
        ImageError: several layers have the same rank.
    """
    candidates = [picture for picture in pictures if not picture.is_aov]
    if not candidates:
        first = pictures[0].layer
        listed = printable(", ".join(dict.fromkeys(picture.layer for picture in pictures)))
        raise NoPictureError(
            f"{path}: has no layer with the finished picture. These layers are AOVs by their "
            f"names: {listed}",
            f"To read one as the picture, add --layer {printable(first)}",
        )
    if len(candidates) == 1:
        return candidates[0]
    best = min(candidates, key=lambda picture: picture.rank)
    equal = {each.layer.lower(): each.layer for each in candidates if each.rank == best.rank}
    if len(equal) > 1:
        listed = printable(", ".join(name or "the one without a name" for name in equal.values()))
        first = next(filter(None, equal.values()))
        raise ImageError(
            f"{path}: {len(equal)} layers may be the picture: {listed}",
            f"Name one with --layer, such as {printable(first)}",
        )
    return best


def _picture_in_layer(path: Path, pictures: list[PictureLocation], layer: str) -> PictureLocation:
    """Return the picture in the first layer of this name, in any case.

    Raises:
        ImageError: there is none.
    """
    names = [layer.lower(), *([""] if layer.lower() == "rgb" else [])]
    found = (each for name in names for each in pictures if each.layer.lower() == name)
    named = next(found, None)
    if not named:
        listed = ", ".join(dict.fromkeys(p.layer or "one without a name" for p in pictures))
        raise ImageError(
            f"{path}: there is no layer {layer!r} with a picture; its layers: {printable(listed)}. "
            "Name one of them with --layer"
        )
    return named


def _rejection(spec: Any, has_levels: bool) -> str:
    """Return why a part cannot be a picture; "" if it may be one."""
    if spec.deep:
        return "this is a deep image (many samples per pixel). Render or flatten it to a flat image"
    if has_levels:
        return (
            "this is a texture (one image in several sizes), not a picture. Write only its largest "
            "level"
        )
    return ""


def full_name(part: str, layer: str) -> str:
    """Return a layer's name with its part's name before it, unless it already begins with that.

    >>> full_name("left", ""), full_name("left", "beauty"), full_name("View", "View.Combined")
    ('left', 'left.beauty', 'View.Combined')
    """
    if f"{layer}.".startswith(f"{part}."):
        return layer
    return f"{part}.{layer}" if part and layer else part or layer


def _layers(names: Sequence[str], is_kept: bool) -> Iterator[tuple[str, tuple[int, ...], bool]]:
    """Yield the layers that can be a picture: name, channels, and whether these are X, Y and Z.

    Channels are called R, G and B, or red, green and blue in Nuke's layers. X, Y and Z are a
    picture only in a layer without a name; in others they are positions or normals. Y is luminance
    if the layer has no other channels except alpha and depth. ``is_kept`` images, which clpipe
    wrote, have neither.

    >>> list(_layers(["comp.red", "comp.green", "comp.blue"], is_kept=False))
    [('comp', (0, 1, 2), False)]
    """
    for layer in dict.fromkeys(name.rpartition(".")[0] for name in names):
        index = {
            _channel(name.rpartition(".")[2]): i
            for i, name in enumerate(names)
            if name.rpartition(".")[0].lower() == layer.lower()
        }
        channels = set(index)
        if channels >= set("rgb"):
            colours = "rgb"
        elif not is_kept and not layer and channels - {"a"} == set("xyz"):
            colours = "xyz"
        elif not is_kept and channels - {"a", "z"} == {"y"}:
            colours = "y"
        else:
            continue
        yield layer, tuple(index[c] for c in colours), colours == "xyz"


def _channel(name: str) -> str:
    """Return a channel's name in lower case; for red, green, blue and alpha, its first letter."""
    lower = name.lower()
    return lower[0] if lower in ("red", "green", "blue", "alpha") else lower


def mosaic_channel(names: Sequence[str]) -> tuple[str, tuple[int]] | None:
    """Return the layer ("") and number of the only channel that is neither alpha nor depth.

    >>> mosaic_channel(["Raw"]), mosaic_channel(["A", "Y"]), mosaic_channel(["X", "Y"])
    (('', (0,)), ('', (1,)), None)
    """
    indices = [i for i, name in enumerate(names) if len(names) == 1 or name not in ("A", "Z")]
    return ("", (indices[0],)) if len(indices) == 1 else None


def picture_channels(names: Sequence[str]) -> tuple[str, tuple[int, ...]] | None:
    """Return the picture's layer, and the numbers of its R, G and B; None if there is no picture.

    >>> picture_channels(["View.Depth.Z", "View.Combined.B", "View.Combined.G", "View.Combined.R"])
    ('View.Combined', (3, 2, 1))
    """
    pictures = [
        PictureLocation(0, name, channels, xyz, 0, name)
        for name, channels, xyz in _layers(names, is_kept=True)
    ]
    if len(pictures) > 1:
        pictures.sort(key=lambda picture: (picture.is_aov, picture.rank))
    return (pictures[0].layer, pictures[0].channels) if pictures else None
