"""Finds the layers of an image: in its file, or in companion files, which are named after it."""

import os
from bisect import bisect_left
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from functools import lru_cache
from pathlib import Path

from clpipe.base.digests import stamp_of
from clpipe.base.errors import ImageError
from clpipe.base.text import one_line, quote_alternatives, similar_names
from clpipe.base.url_text import local
from clpipe.chain.carry import AovSpec
from clpipe.images.clip_frames import clip_of
from clpipe.images.kinds import MIN_CHANNELS, flow_directions, flow_vectors, kind_from_name
from clpipe.images.passes import LayerLocation, find_layers, layer_kind
from clpipe.reference.carried import RESAMPLING, LayerKind, Vector

CARRIED = "carried"  # in file names: the carried layers of NAME are in NAME.carried.exr

# Extensions of companions, in order of preference.
SUFFIXES = (".exr", ".pfm", ".tif", ".tiff", ".png")

SEPARATORS = "_.-"  # in a companion's name, between the image's name and the layer's name


@dataclass(frozen=True)
class LayerSource:
    """A requested layer: its name, kind, file, location in that file, and full channel names."""

    name: str
    kind: LayerKind
    file: Path
    location: LayerLocation
    channels: tuple[str, ...]

    @property
    def vectors(self) -> tuple[Vector, ...]:
        """The vectors in its channels; empty unless its kind is flow."""
        found = flow_vectors(self.location.name or self.name, self.location.channels)
        return found if self.kind == "flow" else ()

    @property
    def directions(self) -> tuple[int, ...]:
        """For each of its vectors, whether it leads forward (1) or back (-1) in time."""
        return flow_directions(f"{self.name} {self.location.name}", self.location.channels)


def find_carried_layers(
    path: Path, layers: Sequence[AovSpec], picture: str = ""
) -> list[LayerSource]:
    """Return all requested layers of an image; see :meth:`LayerFinder.find`.

    Args:
        path: the image file.
        layers: the requested layers.
        picture: the name of the layer that contains the picture.

    Raises:
        ImageError: a layer is missing, or a channel is carried twice.
    """
    found: list[LayerSource] = []
    for layer in layers:
        patterns = [layer.pattern] if layer.pattern else []
        found += LayerFinder(path, patterns, picture).find(layer)
    _check_names(path, found)
    return found


def _check_names(path: Path, found: Sequence[LayerSource]) -> None:
    """Check that no channel is carried twice.

    Raises:
        ImageError: one is.
    """
    owner_by_channel: dict[str, LayerSource] = {}
    for each in found:
        for channel in each.channels:
            other = owner_by_channel.setdefault(channel, each)
            if other is not each:
                raise ImageError(
                    f"{path}: --carry {other.name} and {each.name} both contain the channel "
                    f"{channel}; omit one of them"
                )


@dataclass(frozen=True)
class LayerFinder:
    """Finds layers of an image, first in its file and then in its companions.

    Args:
        path: the image file.
        patterns: patterns of companion names; without any, :func:`companions_of` finds companions.
        picture: the name of the layer that contains the picture.
        layers: the layers of each file that has been read so far.
    """

    path: Path
    patterns: Sequence[str] = ()
    picture: str = ""
    layers: dict[Path, list[LayerLocation]] = field(default_factory=dict)

    def find(self, spec: AovSpec) -> list[LayerSource]:
        """Return the source of a requested layer, or one source for each rank of a Cryptomatte.

        Raises:
            ImageError: there is no such layer, its name is ambiguous, or its kind is not known.
        """
        for file in self._files(spec.name):
            locations = self._layers_in(file)
            if file == self.path:
                named = _named(file, spec.name, self._of_picture(spec.name, locations))
            else:
                named = _named(file, spec.name, locations)
            if not named and self._is_named_after(file, spec.name):
                if len(locations) != 1:
                    listed = ", ".join(each.name or "one without a name" for each in locations)
                    raise ImageError(
                        f"{file}: this file has no layer {spec.name!r}. It has the layers "
                        f"{listed}; name one of these in --carry"
                    )
                named = locations
            if named:
                self._check_unique(spec.name, file)
                return [self._layer_source(spec, file, each) for each in named]
        layers = [each.without_rank for file in self.layers for each in self._layers_in(file)]
        names = dict.fromkeys(layer.rpartition(".")[2] for layer in layers if layer)
        similar = similar_names(spec.name, names)
        hint = f" (did you mean {quote_alternatives(similar)}?)" if similar else ""
        files = [file.name for file in self.layers if file != self.path]
        where = f"the file and {', '.join(files)} have" if files else "the file has"
        clip, layer = clip_of(self.path), one_line(spec.name)
        expected = f"{self.path.stem}_{layer}.exr next to it"
        if clip:
            below = f"{clip.stem}_{layer}", self.path.name
            expected = "{0}.mkv/{1} or {0}/{1}.png next to its clip".format(*below)
        raise ImageError(
            f"{self.path}: --carry: there is no layer '{one_line(spec.name)}'{hint}; {where} "
            f"{', '.join(map(one_line, names)) or 'no layers besides the picture'}, and there "
            f"is no {expected}; render the layer into one of these files"
        )

    def _of_picture(self, name: str, locations: Sequence[LayerLocation]) -> Sequence[LayerLocation]:
        """Return the layers of the picture's own view and view layer; a full name is one of them.

        Raises:
            ImageError: a layer has this name, but in another view or view layer.
        """
        picture = next((each for each in locations if each.name == self.picture), None)
        matching = [each for each in locations if each.matches(name)]
        if picture is None or not matching:
            return locations
        full = [each for each in matching if "." in name and each.name.lower() == name.lower()]
        layer = picture.view_layer
        own = [each for each in matching if each.view == picture.view]
        own = [each for each in own if not layer or each.view_layer in ("", layer)]
        if full or own:
            return full or own
        others = ", ".join(one_line(each.name) for each in matching)
        raise ImageError(
            f"{self.path}: --carry {name}: the picture is {one_line(self.picture) or 'the first'}, "
            f"and its view layer and view have no such layer. The file has {others}; to carry one "
            "of these, give its full name"
        )

    def _check_unique(self, name: str, file: Path) -> None:
        """Check that no other companion of the same format has this layer, which might differ.

        Raises:
            ImageError: there is one.
        """
        is_called = self._is_named_after(file, name)
        for other in companions_of(self.path, self.patterns) if file != self.path else ():
            if other == file or other.suffix.lower() != file.suffix.lower():
                continue
            is_duplicate = (
                self._is_named_after(other, name)
                if is_called
                else self._has_no_picture(other) and _named(other, name, self._layers_in(other))
            )
            if is_duplicate:
                pattern = f"{{name}}{file.name.removeprefix(self.path.stem)}"
                raise ImageError(
                    f"{self.path}: --carry {name}: {file.name} and {other.name} both have this "
                    f"layer. Choose one, for example with --carry {name}={pattern}"
                )

    def _files(self, name: str) -> Iterator[Path]:
        """Yield the files that may contain a layer, in the order in which they are searched."""
        if self.path.suffix.lower() in SUFFIXES:
            yield self.path
        companions = companions_of(self.path, self.patterns)
        named_after = [file for file in companions if self._is_named_after(file, name)]
        yield from named_after
        yield from (f for f in companions if f not in named_after and self._has_no_picture(f))

    def _is_named_after(self, file: Path, name: str) -> bool:
        """Return whether a companion contains a layer according to its name or pattern."""
        if file == self.path:
            return False
        clip = clip_of(self.path)
        own = _layer_suffix(clip, file.parent.name) if clip else _layer_suffix(self.path, file.name)
        return bool(self.patterns) or own.lower() == name.lower()

    def _has_no_picture(self, file: Path) -> bool:
        """Return whether a file can be read and contains no picture."""
        try:
            return not any(each.is_colour and not each.name for each in self._layers_in(file))
        except ImageError:
            return False

    def _layers_in(self, file: Path) -> list[LayerLocation]:
        if file not in self.layers:
            self.layers[file] = find_layers(file)
        return self.layers[file]

    def _layer_source(self, spec: AovSpec, file: Path, location: LayerLocation) -> LayerSource:
        kind = spec.kind or layer_kind(spec.name, location)
        if kind is None:
            raise ImageError(
                f"{file}: the kind of its layer {spec.name} is not known from the name. Add it: "
                f"--carry {spec.name}:KIND, where KIND is one of {', '.join(RESAMPLING)}"
            )
        min_channels = MIN_CHANNELS.get(kind, 1)
        if len(location.channels) < min_channels:
            raise ImageError(
                f"{file}: its layer {spec.name} has {len(location.channels)} "
                f"channel{'s' * (len(location.channels) > 1)}, but a layer of {kind} needs "
                f"{min_channels} or more; choose another kind with --carry {spec.name}:KIND"
            )
        is_bare_channel = location.channels == (location.name,)
        is_named = location.name and not (is_bare_channel and file != self.path)
        layer = location.name if is_named else spec.name
        # A channel of a view, such as right.Z, is named like its layer.
        is_last = location.channels == (location.name.rpartition(".")[2],)
        if is_last and file == self.path:
            return LayerSource(spec.name, kind, file, location, (location.name,))
        channels = [f"{layer}.{name}" for name in location.channels]
        return LayerSource(spec.name, kind, file, location, tuple(channels))


def _named(file: Path, name: str, locations: Sequence[LayerLocation]) -> list[LayerLocation]:
    """Return the layers with a name: one, or the ranks of one Cryptomatte.

    Raises:
        ImageError: several layers have that name.
    """
    found = [each for each in locations if each.matches(name)]
    exact = [each for each in found if each.name.lower() == name.lower()]
    names = sorted({each.without_rank for each in found})
    if len(names) > 1 and len(exact) != 1:
        raise ImageError(
            f"{file}: --carry {name} is ambiguous: it may be {', '.join(names)}; give the full "
            "name of one layer"
        )
    return exact or found


def companions_of(path: Path, patterns: Sequence[str] = ()) -> list[Path]:
    """Return the companions of an image: files next to it that contain its layers.

    Without patterns, a companion has the image's name, then ``_``, ``.`` or ``-``, and more before
    the extension: ``view00_depth.exr`` is a companion of ``view00.exr``. Companions of a clip's
    frame are in a clip or a folder that is named after the clip: ``a_depth.mkv/000012`` or
    ``a_depth/000012.png`` for ``a.mp4/000012``. A pattern is then relative to the clip's folder,
    and ``{name}`` is the frame's number.

    Raises:
        ImageError: a file that a pattern names is missing.
    """
    clip = clip_of(path)
    folder = (clip or path).parent
    named = [folder / local(pattern).replace("{name}", path.stem) for pattern in patterns]
    for file, pattern in zip(named, patterns, strict=True):
        if not any(stamp_of(file)):
            raise ImageError(
                f"{path}: its companion {file} does not exist; correct the pattern in "
                f"--carry ...={pattern}, or render the file"
            )
    if patterns:
        return named
    if clip:
        return _companions_of_frame(path, clip)
    names = _names_in(str(path.parent), stamp_of(path.parent)[1])
    found = []
    for name in names[bisect_left(names, path.stem) :]:
        if not name.startswith(path.stem):
            break
        if Path(name).suffix.lower() in SUFFIXES and _layer_suffix(path, name) not in ("", CARRIED):
            found.append(path.with_name(name))
    return sorted(found, key=lambda file: (SUFFIXES.index(file.suffix.lower()), file.name))


def _companions_of_frame(path: Path, clip: Path) -> list[Path]:
    """Return the companions of a frame of a clip, see :func:`companions_of`."""
    found = []
    for name in _names_in(str(clip.parent), stamp_of(clip.parent)[1]):
        other = clip.with_name(name)
        if name == clip.name or not _layer_suffix(clip, name):
            continue
        if clip_of(other / path.name):
            found.append(other / path.name)
        files = (other / f"{path.name}{suffix}" for suffix in SUFFIXES)
        found += [file for file in files if file.is_file()]
    return found


@lru_cache(maxsize=8)
def _names_in(folder: str, _modified: int) -> list[str]:
    """Return the names in a folder, sorted; an empty list if it cannot be read."""
    try:
        return sorted(os.listdir(folder or "."))
    except OSError:
        return []


def _layer_suffix(path: Path, name: str) -> str:
    """Return the layer's name from a companion's file name, or "" if it is not a companion.

    >>> _layer_suffix(Path("in/a.exr"), "a_depth.exr"), _layer_suffix(Path("in/a.exr"), "ab.exr")
    ('depth', '')
    """
    suffix = Path(name).stem.removeprefix(path.stem)
    return suffix[1:] if suffix[:1] and suffix[0] in SEPARATORS else ""


def owner_of(path: Path) -> str | None:
    """Return the path, without extension, of the image that a file is a companion of, or None.

    >>> owner_of(Path("in/view00_depth.exr")), owner_of(Path("in/view_00.exr"))
    ('in/view00', None)
    """
    stem = path.stem
    split = max(map(stem.rfind, SEPARATORS))
    is_companion = split > 0 and (stem[split + 1 :] == CARRIED or kind_from_name(stem[split + 1 :]))
    return str(path.with_name(stem[:split])) if is_companion else None
