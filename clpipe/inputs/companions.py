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
from clpipe.chain.carry import AovSpec
from clpipe.images.kinds import MIN_CHANNELS, flow_vectors, kind_from_name
from clpipe.images.passes import LayerLocation, find_layers, layer_kind
from clpipe.reference.carried import RESAMPLING, LayerKind, Vector

CARRIED = "carried"  # in file names: the carried layers of NAME are in NAME.carried.exr

SUFFIXES = (".exr", ".pfm", ".tif", ".tiff", ".png")  # of companions, in order of preference

SEPARATORS = "_.-"  # between an image's name and that of a layer, in the name of a companion


@dataclass(frozen=True)
class FoundLayer:
    """A requested layer: its name, kind, file, place in that file, and full channel names."""

    name: str
    kind: LayerKind
    file: Path
    location: LayerLocation
    channels: tuple[str, ...]

    @property
    def vectors(self) -> tuple[Vector, ...]:
        """The vectors that its channels hold; empty unless its kind is flow."""
        own = flow_vectors(self.location.name or self.name, self.location.channels)
        return own if self.kind == "flow" else ()


def find_all(path: Path, layers: Sequence[AovSpec]) -> list[FoundLayer]:
    """Return all requested layers of an image; see :meth:`Finder.find`.

    Raises:
        ImageError: a layer is missing, or a channel is carried twice.
    """
    found: list[FoundLayer] = []
    for layer in layers:
        found += Finder(path, [layer.pattern] if layer.pattern else []).find(layer)
    _check_names(path, found)
    return found


def _check_names(path: Path, found: Sequence[FoundLayer]) -> None:
    """Check that no channel is carried twice.

    Raises:
        ImageError: one is.
    """
    owners: dict[str, FoundLayer] = {}
    for each in found:
        for channel in each.channels:
            other = owners.setdefault(channel, each)
            if other is not each:
                raise ImageError(
                    f"{path}: --carry {other.name} and {each.name} both contain the channel "
                    f"{channel}; omit one of them"
                )


@dataclass(frozen=True)
class Finder:
    """Finds layers of an image, first in its file and then in its companions.

    Args:
        path: the image file.
        patterns: patterns of companion names; without any, :func:`companions_of` finds companions.
        layers: the layers of each file that has been read so far.
    """

    path: Path
    patterns: Sequence[str] = ()
    layers: dict[Path, list[LayerLocation]] = field(default_factory=dict)

    def find(self, asked: AovSpec) -> list[FoundLayer]:
        """Return where a requested layer is: one place, or one for each rank of a Cryptomatte.

        Raises:
            ImageError: there is no such layer, its name is ambiguous, or its kind is not known.
        """
        for file in self._files(asked.name):
            locations = self._of(file)
            named = _named(file, asked.name, locations)
            if not named and self._is_called(file, asked.name):
                if len(locations) != 1:
                    listed = ", ".join(each.name or "one without a name" for each in locations)
                    raise ImageError(
                        f"{file}: this file has no layer called {asked.name}, but several others "
                        f"({listed}). Name one of them in --carry"
                    )
                named = locations
            if named:
                self._check_alone(asked.name, file)
                return [self._found(asked, file, each) for each in named]
        layers = [each.without_rank for file in self.layers for each in self._of(file)]
        names = dict.fromkeys(layer.rpartition(".")[2] for layer in layers if layer)
        near = similar_names(asked.name, names)
        hint = f" (did you mean {quote_alternatives(near)}?)" if near else ""
        files = [file.name for file in self.layers if file != self.path]
        where = f"the file and {', '.join(files)} have" if files else "the file has"
        expected = f"{self.path.stem}_{one_line(asked.name)}.exr"
        raise ImageError(
            f"{self.path}: --carry: there is no layer '{one_line(asked.name)}'{hint}; {where} "
            f"{', '.join(map(one_line, names)) or 'no layers besides the picture'}, and there is "
            f"no {expected} next to it; render the layer into one of them"
        )

    def _check_alone(self, name: str, file: Path) -> None:
        """Check that no other companion of the same format has this layer, which might differ.

        Raises:
            ImageError: there is one.
        """
        is_called = self._is_called(file, name)
        for other in companions_of(self.path, self.patterns) if file != self.path else ():
            if other == file or other.suffix.lower() != file.suffix.lower():
                continue
            is_second = (
                self._is_called(other, name)
                if is_called
                else self._holds_no_colour(other) and _named(other, name, self._of(other))
            )
            if is_second:
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
        called = [file for file in companions if self._is_called(file, name)]
        yield from called
        yield from (f for f in companions if f not in called and self._holds_no_colour(f))

    def _is_called(self, file: Path, name: str) -> bool:
        """Return whether a companion holds a layer according to its name or pattern."""
        if file == self.path:
            return False
        return bool(self.patterns) or _tail(self.path, file.name).lower() == name.lower()

    def _holds_no_colour(self, file: Path) -> bool:
        """Return whether a file can be read and has no picture of its own."""
        try:
            return not any(each.is_colour and not each.name for each in self._of(file))
        except ImageError:
            return False

    def _of(self, file: Path) -> list[LayerLocation]:
        if file not in self.layers:
            self.layers[file] = find_layers(file)
        return self.layers[file]

    def _found(self, asked: AovSpec, file: Path, location: LayerLocation) -> FoundLayer:
        kind = asked.kind or layer_kind(asked.name, location)
        if kind is None:
            raise ImageError(
                f"{file}: the kind of its layer {asked.name} is not known from the name. Add it: "
                f"--carry {asked.name}:KIND, where KIND is one of {', '.join(RESAMPLING)}"
            )
        least = MIN_CHANNELS.get(kind, 1)
        if len(location.channels) < least:
            raise ImageError(
                f"{file}: its layer {asked.name} has {len(location.channels)} "
                f"channel{'s' * (len(location.channels) > 1)}, but a layer of {kind} needs {least} "
                f"or more; choose another kind with --carry {asked.name}:KIND"
            )
        is_named = location.name and not (location.is_bare_channel and file != self.path)
        layer = location.name if is_named else asked.name
        alone = location.is_bare_channel and file == self.path
        channels = [name if alone else f"{layer}.{name}" for name in location.channels]
        return FoundLayer(asked.name, kind, file, location, tuple(channels))


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
            "name of one"
        )
    return exact or found


def companions_of(path: Path, patterns: Sequence[str] = ()) -> list[Path]:
    """Return the companions of an image: files next to it that contain its layers.

    Without patterns, a companion has the image's name, then ``_``, ``.`` or ``-``, and more before
    the extension: ``view00_depth.exr`` is a companion of ``view00.exr``.

    Raises:
        ImageError: a file that a pattern names is missing.
    """
    named = [path.parent / pattern.replace("{name}", path.stem) for pattern in patterns]
    for file, pattern in zip(named, patterns, strict=True):
        if not file.is_file():
            raise ImageError(
                f"{path}: its companion {file} does not exist; correct the pattern in "
                f"--carry ...={pattern}, or render the file"
            )
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
    """Return the names in a folder, sorted; an empty list if it cannot be read."""
    try:
        return sorted(os.listdir(folder or "."))
    except OSError:
        return []


def _tail(path: Path, name: str) -> str:
    """Return the layer's name in the name of a companion; "" if the file is not a companion.

    >>> _tail(Path("in/a.exr"), "a_depth.exr"), _tail(Path("in/a.exr"), "ab.exr")
    ('depth', '')
    """
    rest = Path(name).stem.removeprefix(path.stem)
    return rest[1:] if rest[:1] and rest[0] in SEPARATORS else ""


def owner_of(path: Path) -> str | None:
    """Return the path, without extension, of the image that a file is a companion of, or None.

    >>> owner_of(Path("in/view00_depth.exr")), owner_of(Path("in/view_00.exr"))
    ('in/view00', None)
    """
    stem = path.stem
    cut = max(map(stem.rfind, SEPARATORS))
    is_companion = cut > 0 and (stem[cut + 1 :] == CARRIED or kind_from_name(stem[cut + 1 :]))
    return str(path.with_name(stem[:cut])) if is_companion else None
