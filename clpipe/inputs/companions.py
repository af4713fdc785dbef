"""Layers of an image: found in its file, or in files that belong to it by their names."""

import os
from bisect import bisect_left
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from functools import lru_cache
from pathlib import Path

from clpipe.base.digests import stamp_of
from clpipe.base.errors import ImageError
from clpipe.base.text import alike, either, one_line
from clpipe.chain.carry import AovSpec
from clpipe.images.kinds import CHANNELS, kind_named, vectors_of
from clpipe.images.passes import LayerLocation, find_layers, kind_of
from clpipe.reference.carried import RESAMPLING, LayerKind, Vector

CARRIED = "carried"  # what stands behind an image's name in that of its carried layers

SUFFIXES = (".exr", ".pfm", ".tif", ".tiff", ".png")  # of companions, the preferred one first

SEPARATORS = "_.-"  # between an image's name and what its companion holds


@dataclass(frozen=True)
class FoundLayer:
    """Where a layer that was asked for is, and what it holds."""

    name: str
    kind: LayerKind
    file: Path
    location: LayerLocation
    channels: tuple[str, ...]

    @property
    def vectors(self) -> tuple[Vector, ...]:
        """The vectors in it; none where it is no flow."""
        own = vectors_of(self.location.name or self.name, self.location.channels)
        return own if self.kind == "flow" else ()


def find_all(path: Path, layers: Sequence[AovSpec]) -> list[FoundLayer]:
    """All layers of an image that are asked for; see :meth:`Finder.find`.

    Raises:
        ImageError: one is missing, or a channel is carried twice.
    """
    found: list[FoundLayer] = []
    for layer in layers:
        found += Finder(path, [layer.pattern] if layer.pattern else []).find(layer)
    _check_names(path, found)
    return found


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
                    f"{path}: --carry {other.name} and {each.name} both name the channel "
                    f"{channel}. Name it once"
                )


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
                        f"{file}: has no layer called {asked.name}, but several others ({listed}). "
                        "Name one of them in --carry"
                    )
                named = locations
            if named:
                self._check_alone(asked.name, file)
                return [self._found(asked, file, each) for each in named]
        layers = [each.without_rank for file in self.layers for each in self._of(file)]
        names = dict.fromkeys(layer.rpartition(".")[2] for layer in layers if layer)
        near = alike(asked.name, names)
        hint = f" (did you mean {either(near)}?)" if near else ""
        files = [file.name for file in self.layers if file != self.path]
        where = f"the file and {', '.join(files)} have" if files else "the file has"
        expected = f"{self.path.stem}_{one_line(asked.name)}.exr"
        raise ImageError(
            f"{self.path}: --carry: no layer '{one_line(asked.name)}'{hint}; {where} "
            f"{', '.join(map(one_line, names)) or 'no layers besides the picture'}, and there is "
            f"no {expected} next to it; render the layer into one of them"
        )

    def _check_alone(self, name: str, file: Path) -> None:
        """See that no other companion of the same format holds a layer, which may differ.

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
                    f"{self.path}: --carry {name}: {file.name} and {other.name} both have it. "
                    f"Name the right one, such as --carry {name}={pattern}"
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
                f"{file}: the name of its layer {asked.name} does not tell what it holds. Add its "
                f"kind: --carry {asked.name}:KIND, where KIND is {', '.join(RESAMPLING)}"
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
            raise ImageError(f"{path}: it has no companion {file} (--carry ...={pattern})")
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
