"""Layers that go along with a picture: found in its file or beside it, and moved as its pixels."""

import os
from bisect import bisect_left
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np

from clpipe.base.digests import digests, stamp_of
from clpipe.base.errors import ImageError, RequestError
from clpipe.base.reading import unchanged
from clpipe.base.text import one_of
from clpipe.base.types import Array
from clpipe.chain.carry import AovSpec
from clpipe.chain.chain import Chain
from clpipe.images.kinds import CHANNELS, kind_named, vectors_of
from clpipe.images.passes import (
    LayerLocation,
    cryptomatte_attributes,
    find_layers,
    kind_of,
    read_layer,
)
from clpipe.images.read import SourceImage
from clpipe.images.tags import FLIPS
from clpipe.reference.carried import RESAMPLING, Layer, LayerKind, warp
from clpipe.reference.geometry import Composition, Geometry, Orientation

CARRIED = "carried"  # what stands behind an image's name in that of its carried layers

SUFFIXES = (".exr", ".pfm", ".tif", ".tiff", ".png")  # of companions, the preferred one first

SEPARATORS = "_.-"  # between an image's name and what its companion holds


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


@dataclass(frozen=True)
class FoundLayer:
    """Where a layer that was asked for is, and what it holds."""

    name: str
    kind: LayerKind
    file: Path
    location: LayerLocation
    channels: tuple[str, ...]


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
    found: list[FoundLayer] = []
    for layer in layers:
        found += Finder(path, [layer.pattern] if layer.pattern else []).find(layer)
    _check_names(path, found)
    read: list[Layer] = []
    attributes: dict[str, str] = {}
    sums: dict[Path, str] = {}
    for each in found:
        with unchanged(each.file):
            pixels, (x, y), size = read_layer(each.file, each.location, max_pixels)
            sums |= {each.file: digests([str(each.file)]).get(str(each.file), "")}
            attributes |= cryptomatte_attributes(each.file, each.location.part)
        if size != (width, height):
            raise ImageError(
                f"{each.file}: its layer {each.name} has {size[0]}x{size[1]} pixels, but the "
                f"picture {path} has {width}x{height}; render both at one size"
            )
        vectors = vectors_of(each.location.name or each.name, each.location.channels)
        x, y = x + source.margins.left, y + source.margins.top
        read.append(Layer(each.kind, pixels, x, y, vectors if each.kind == "flow" else ()))
    moved, valid = warp(read, geometry_of(chain, orientation), *whole)
    carried = tuple(
        Aov(each.name, each.kind, each.channels, pixels, _record(path, each, sums))
        for each, pixels in zip(found, moved, strict=True)
    )
    return Aovs(carried, valid, attributes)


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


def _check_names(path: Path, found: Sequence[FoundLayer]) -> None:
    """See that no channel is carried twice.

    Raises:
        ImageError: one is.
    """
    owners: dict[str, FoundLayer] = {}
    for each in found:
        for channel in each.channels:
            other = owners.setdefault(channel, each)
            if other is not each:
                raise ImageError(
                    f"{path}: --carry {other.name} and {each.name} are both the channel {channel}"
                )


def _record(path: Path, layer: FoundLayer, sums: Mapping[Path, str]) -> dict[str, Any]:
    size, modified = stamp_of(layer.file)
    return {
        "layer": layer.name,
        "kind": layer.kind,
        "resampling": RESAMPLING[layer.kind],
        "channels": list(layer.channels),
        "file": os.path.relpath(layer.file, path.parent),
        "size": size,
        "modified": modified,
        "sha256": sums[layer.file],
    }


@dataclass(frozen=True)
class Finder:
    """Finds layers of an image, in its file and then in its companions.

    Args:
        path: of the image.
        patterns: of the names of companions; none are those that :func:`companions_of` finds.
    """

    path: Path
    patterns: Sequence[str] = ()
    layers: dict[Path, list[LayerLocation]] = field(default_factory=dict)  # of the files so far

    def find(self, asked: AovSpec) -> list[FoundLayer]:
        """A layer that is asked for; of a Cryptomatte each rank.

        Raises:
            ImageError: it is not there, its name means several, or what it holds is unknown.
        """
        for file in self._files(asked.name):
            locations = self._of(file)
            named = _named(file, asked.name, locations)
            if not named and self._is_called(file, asked.name):
                if len(locations) != 1:
                    listed = ", ".join(each.name or "one without a name" for each in locations)
                    raise ImageError(
                        f"{file}: has no layer called {asked.name}, but several others ({listed}); "
                        "carry one of these"
                    )
                named = locations
            if named:
                return [self._found(asked, file, each) for each in named]
        layers = [each.without_rank for file in self.layers for each in self._of(file)]
        names = dict.fromkeys(layer.rpartition(".")[2] for layer in layers if layer)
        message = one_of("layer", asked.name, names).replace("unknown", "no")
        files = [str(file) for file in self.layers if file != self.path]
        beside = f" and in {', '.join(files)}" if files else ", and no companion was found"
        raise ImageError(
            f"{self.path}: --carry: {message.replace('; allowed:', '; there are:')}; looked in it"
            f"{beside}"
        )

    def _files(self, name: str) -> Iterator[Path]:
        """Where a layer may be, in the order in which it is looked for."""
        if self.path.suffix.lower() in SUFFIXES:
            yield self.path
        companions = companions_of(self.path, self.patterns)
        called = [file for file in companions if self._is_called(file, name)]
        yield from called
        yield from (f for f in companions if f not in called and self._holds_no_colour(f))

    def _is_called(self, file: Path, name: str) -> bool:
        """Whether a companion's name, or its pattern, says that it holds a layer."""
        if file == self.path:
            return False
        return bool(self.patterns) or _tail(self.path, file.name).lower() == name.lower()

    def _holds_no_colour(self, file: Path) -> bool:
        """Whether a file can be read, and is no picture of its own."""
        try:
            return not any(each.is_colour and not each.name for each in self._of(file))
        except ImageError:
            return False

    def _of(self, file: Path) -> list[LayerLocation]:
        if file not in self.layers:
            self.layers[file] = find_layers(file)
        return self.layers[file]

    def _found(self, asked: AovSpec, file: Path, location: LayerLocation) -> FoundLayer:
        kind = asked.kind or kind_of(asked.name, location)
        if kind is None:
            raise ImageError(
                f"{file}: what its layer {asked.name} holds cannot be told by its name; say it: "
                f"--carry {asked.name}:KIND, which is {', '.join(RESAMPLING)}"
            )
        least = CHANNELS.get(kind, 1)
        if len(location.channels) < least:
            raise ImageError(
                f"{file}: its layer {asked.name} has {len(location.channels)} channel, but {kind} "
                f"has {least} or more"
            )
        is_named = location.name and not (location.is_alone and file != self.path)
        layer = location.name if is_named else asked.name
        alone = location.is_alone and file == self.path
        channels = [name if alone else f"{layer}.{name}" for name in location.channels]
        return FoundLayer(asked.name, kind, file, location, tuple(channels))


def _named(file: Path, name: str, locations: Sequence[LayerLocation]) -> list[LayerLocation]:
    """The layers that a name means: one, or the ranks of one Cryptomatte.

    Raises:
        ImageError: it means several.
    """
    found = [each for each in locations if each.answers_to(name)]
    exact = [each for each in found if each.name.lower() == name.lower()]
    names = sorted({each.without_rank for each in found})
    if len(names) > 1 and len(exact) != 1:
        raise ImageError(f"{file}: --carry {name}: it may be {', '.join(names)}; name one in full")
    return exact or found


def companions_of(path: Path, patterns: Sequence[str] = ()) -> list[Path]:
    """The files beside an image that belong to it.

    Without patterns these are called as the image, with a ``_``, ``.`` or ``-`` and something more
    before the ending: ``view00_depth.exr`` beside ``view00.exr``.

    Raises:
        ImageError: a pattern names a file that is missing.
    """
    named = [path.parent / pattern.replace("{name}", path.stem) for pattern in patterns]
    for file, pattern in zip(named, patterns, strict=True):
        if not file.is_file():
            raise ImageError(f"{path}: it has no companion {file} (--companion '{pattern}')")
    if patterns:
        return named
    names = _names_in(str(path.parent), stamp_of(path.parent)[1])
    found = []
    for name in names[bisect_left(names, path.stem) :]:
        if not name.startswith(path.stem):
            break
        if Path(name).suffix.lower() in SUFFIXES and _tail(path, name) not in ("", CARRIED):
            found.append(path.with_name(name))
    return sorted(found, key=lambda file: (SUFFIXES.index(file.suffix.lower()), file.name))


@lru_cache(maxsize=8)
def _names_in(folder: str, _modified: int) -> list[str]:
    """The names in a folder, sorted; none where it cannot be read."""
    try:
        return sorted(os.listdir(folder or "."))
    except OSError:
        return []


def _tail(path: Path, name: str) -> str:
    """What a companion's name says that it holds; "" for the name of another image.

    >>> _tail(Path("in/a.exr"), "a_depth.exr"), _tail(Path("in/a.exr"), "ab.exr")
    ('depth', '')
    """
    rest = Path(name).stem.removeprefix(path.stem)
    return rest[1:] if rest[:1] and rest[0] in SEPARATORS else ""


def owner_of(path: Path) -> str | None:
    """The path, without an ending, of the image whose companion a file is by its name.

    >>> owner_of(Path("in/view00_depth.exr")), owner_of(Path("in/view_00.exr"))
    ('in/view00', None)
    """
    stem = path.stem
    cut = max(map(stem.rfind, SEPARATORS))
    is_companion = cut > 0 and (stem[cut + 1 :] == CARRIED or kind_named(stem[cut + 1 :]))
    return str(path.with_name(stem[:cut])) if is_companion else None
