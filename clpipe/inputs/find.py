"""Finds the images of a run in files, folders, globs and manifests, and names their outputs."""

import glob
import logging
import os
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from fnmatch import fnmatchcase
from functools import cached_property
from pathlib import Path
from typing import Any, TypeVar

from clpipe.base.errors import ImageError, RequestError
from clpipe.base.reading import check_input
from clpipe.base.text import printable, whole_number
from clpipe.base.urls import is_glob, is_url, listed, path_of, url_of
from clpipe.chain.rendition import Rendition
from clpipe.images.raw import RAW_SUFFIXES
from clpipe.images.read import PICTURE_SUFFIXES, RENDER_SUFFIXES
from clpipe.inputs.companions import owner_of
from clpipe.inputs.manifest import MANIFEST_SUFFIXES, read_manifest

T = TypeVar("T")

log = logging.getLogger(__name__)

# What files are that are no images, by their endings, and what to do with them.
NO_IMAGES = {
    ".json": "it is JSON, no image; to make the picture of a sidecar again, use 'clpipe replay'",
    ".toml": "it is a configuration or a camera, no image; name it with -c or --camera",
    ".blend": "it is a scene of Blender, no image; to render and develop it, use 'clpipe dataset'",
}

FINISHED = (
    "Finished pictures are not linear light. For renders, add --transfer srgb; for photographs, "
    "use -c unprocess"
)


@dataclass(frozen=True)
class Job:
    """One image to make pictures of.

    Args:
        path: the file.
        key: its name among the inputs, from which draws and the names of outputs follow.
        name: the path of its outputs in the output folder, without an ending; "" follows the key.
        listed: whether it was named, matched or in a manifest, and not found in a folder.
        values: settings that hold for it alone, nested as in a configuration.
        frames: how many frames are made of it; None is what the request says.
        place: the manifest and the row that it stands in; "" where it is in none.
        renditions: those to make; None is all.
        written: the path as the user wrote it, where ``path`` has been made absolute.
        subframes: further files of the same exposure.
        size: the width and height in px that it must have; None is any.
        around: whether its files are views of one place, and no sub-frames.
        problem: why it cannot be made, as far as that is known before it is read.
    """

    path: Path
    key: str
    name: str = ""
    listed: bool = True
    values: Mapping[str, Any] = field(default_factory=dict)
    frames: int | None = None
    place: str = ""
    renditions: tuple[Rendition, ...] | None = None
    written: str = ""
    subframes: tuple[Path, ...] = ()
    size: tuple[int, int] | None = None
    problem: str = ""
    around: bool = False

    def check(self) -> None:
        """See that nothing is known that keeps it from being made.

        Raises:
            ImageError: there is.
        """
        if self.problem:
            raise ImageError(f"{self.label}: {self.problem}")

    @property
    def paths(self) -> tuple[Path, ...]:
        """All files of its exposure, the first one first."""
        return (self.path, *self.subframes)

    def at(self, moment: str) -> Path:
        """The file of its exposure at a moment of it: "start", "middle" or "end".

        Of an even number of files the middle one is the last before the middle.
        """
        places = {"start": 0, "middle": (len(self.paths) - 1) // 2, "end": -1}
        return self.paths[places[moment]]

    @property
    def shown(self) -> str:
        """The file as messages and logs name it: by its URL where it has one."""
        return url_of(self.path) or str(self.path)

    @property
    def input(self) -> str:
        """The path as it is stored and printed."""
        return self.written or self.shown

    @cached_property
    def stem(self) -> str:
        """The path of its outputs in the output folder, without an ending."""
        return self.name or str(Path(self.key).with_suffix(""))

    @property
    def label(self) -> str:
        """The job as an error names it."""
        return f"{self.shown} ({self.place})" if self.place else self.shown


def find_jobs(
    inputs: Sequence[str],
    output: Path,
    endings: Sequence[str] = (*RENDER_SUFFIXES, *RAW_SUFFIXES),
    exclude: Sequence[str] = (),
) -> list[Job]:
    """The jobs of a run, in the order of its inputs.

    The key of a file in a folder is its path relative to that folder; that of a file which is
    named or matches a glob is its name; a manifest's rows have their own. A row whose file is
    missing is a job, which fails later without the others.

    Args:
        inputs: files, folders (all images in them, at any depth), globs and manifests.
        output: the output folder; where it lies inside an input folder, its files are no inputs.
        endings: of the files that are taken from folders.
        exclude: patterns of what is not taken from folders and globs, see :class:`Exclusion`.

    A file that goes with another one, see :func:`without_companions`, is no job.

    Raises:
        RequestError: no input, an empty name, a folder without images, or one that cannot be read,
            a glob that no file matches, or a manifest that is wrong.
        MissingError: a file that is named does not exist.
    """
    jobs: list[Job] = []
    if not inputs:
        raise RequestError("there is no input; give files, folders, globs or manifests")
    excluded = Exclusion(exclude)
    for text in inputs:
        if not text:
            raise RequestError("an input is empty; give files, folders, globs or manifests")
        path = path_of(text)
        if is_url(text) and path.suffix.lower() not in MANIFEST_SUFFIXES:
            jobs += _jobs_behind(text, endings, excluded)
        elif os.path.isdir(text):
            files = images_in(path, output, endings, excluded)
            jobs += [Job(p, p.relative_to(path).as_posix(), listed=False) for p in files]
        elif path.suffix.lower() in MANIFEST_SUFFIXES:
            jobs += [
                Job(row.path, row.key, row.name, True, row.values, row.frames, row.place)
                for row in read_manifest(path)
            ]
        elif glob.has_magic(text) and not os.path.exists(text):
            matches = sorted(m for m in glob.glob(text, recursive=True) if os.path.isfile(m))
            if not matches:
                raise RequestError(f"{text}: no file matches")
            jobs += [Job(Path(m), Path(m).name) for m in matches if m not in excluded]
        else:
            check_input(path)
            if no_image := NO_IMAGES.get(path.suffix.lower()):
                raise RequestError(f"{path}: {no_image}")
            jobs.append(Job(path, path.name))
    for pattern in excluded.unused:
        log.warning("--exclude %s: matches nothing", pattern)
    jobs = without_companions(jobs)
    if not jobs:
        raise RequestError("every file is excluded")
    return jobs


def without_companions(jobs: Sequence[Job]) -> list[Job]:
    """The jobs but for those of files that belong to another job's image by their names.

    So ``view00_depth.exr`` is no image beside ``view00.exr``. What a manifest lists is an image.
    """
    stems = {str(job.path.with_suffix("")) for job in jobs}
    found = [job for job in jobs if not job.place and owner_of(job.path) in stems]
    if found:
        goes = "1 file goes" if len(found) == 1 else f"{len(found)} files go"
        first = printable(str(found[0].path))
        log.info("%s with an image beside, such as %s; see --carry", goes, first)
    others = {id(job) for job in found}
    return [job for job in jobs if id(job) not in others]


class Exclusion:
    """Patterns (* ? []) of paths relative to an input folder, or of names of files or folders."""

    def __init__(self, patterns: Sequence[str] = ()) -> None:
        self._patterns = patterns
        self.unused = dict.fromkeys(patterns)  # those that have matched nothing yet

    def __bool__(self) -> bool:
        return bool(self._patterns)

    def __contains__(self, path: str) -> bool:
        name = os.path.basename(path)
        matching = [p for p in self._patterns if fnmatchcase(path, p) or fnmatchcase(name, p)]
        for pattern in matching:
            self.unused.pop(pattern, None)
        return bool(matching)


def _jobs_behind(url: str, endings: Sequence[str], excluded: Exclusion) -> list[Job]:
    """The jobs of a URL: of a file, of all images below it, or of those that a glob matches.

    Raises:
        RequestError: it cannot be listed, or there are none.
    """
    is_pattern = is_glob(url)
    if not is_pattern and Path(url).suffix.lower() in endings:  # one that is missing fails alone
        return [Job(path_of(url), url.rpartition("/")[2])]
    root = url.rstrip("/")
    jobs = []
    for each in listed(url):
        is_below = each.startswith(f"{root}/") and not is_pattern
        key = each.removeprefix(f"{root}/") if is_below else each.rpartition("/")[2]
        hidden = any(part.startswith(".") for part in key.split("/"))
        suffix = Path(key).suffix.lower()
        if (is_below and (hidden or suffix not in endings)) or key in excluded:
            continue
        try:
            path = path_of(each)
        except RequestError as error:
            log.warning("%s; it is left out", error)
            continue
        jobs.append(Job(path, key, listed=not is_below))
    if not jobs:
        raise RequestError(f"{url}: no image is there (looked for {', '.join(endings[:6])} ...)")
    return jobs


def images_in(
    folder: Path, output: Path, endings: Sequence[str], excluded: Exclusion
) -> list[Path]:
    """The images in a folder at any depth, sorted; how many other files there are is logged.

    Hidden files and the output folder are left out. A link that leads nowhere is an image, too: it
    fails later.

    Raises:
        RequestError: a folder cannot be read, or there is no image.
    """
    images: list[Path] = []
    others: Counter[str] = Counter()
    for place, names in _walk(folder, output, excluded):
        below = os.path.relpath(place, folder)
        for name in names:
            if name.startswith(".") or os.path.normpath(f"{below}/{name}") in excluded:
                continue
            path = Path(place, name)
            suffix = path.suffix.lower()
            if suffix in endings and (path.is_file() or path.is_symlink()):
                images.append(path)
            else:
                others["pipe or device" if suffix in endings else suffix or "without suffix"] += 1
    ranked = sorted(others.items(), key=lambda item: (-item[1], item[0]))
    kinds = [f"{count} {suffix}" for suffix, count in ranked[:5]]
    kinds += ["others"] * (len(others) > len(kinds))
    listed = printable(", ".join(kinds))
    if not images:
        left = " that are not excluded" if excluded else ""
        looked = ", ".join(e for e in endings if e not in RAW_SUFFIXES)
        raws = " and camera raws" if set(RAW_SUFFIXES) & set(endings) else ""
        text = f"{folder}: this folder has no images{left}; clpipe looked for {looked}{raws}"
        text += f", and the folder has {listed}" if listed else ""
        if others.keys() & set(PICTURE_SUFFIXES):
            text += f". {FINISHED}"
        raise RequestError(text)
    if others:
        are, were = ("file is", "was") if others.total() == 1 else ("files are", "were")
        log.info("%s: %d %s no image and %s ignored: %s", folder, others.total(), are, were, listed)
    return sorted(images)


def _walk(folder: Path, output: Path, excluded: Exclusion) -> Iterator[tuple[str, list[str]]]:
    """Each folder below one, with the names of its files. Links are followed after all folders.

    So a file that can be reached by a link, too, has the path without it, whatever the order of
    the folder is on disk.

    Raises:
        RequestError: a folder cannot be read.
    """
    visited: set[str] = set()
    starts = [str(folder)]
    for start in starts:  # which grows
        for place, folders, names in os.walk(start, onerror=_refuse):
            real = os.path.realpath(place)
            if real in visited or (visited and real == os.path.realpath(output)):
                folders.clear()
                continue
            visited.add(real)
            below = {name: os.path.join(place, name) for name in sorted(folders)}
            taken = [
                n for n, path in below.items() if os.path.relpath(path, folder) not in excluded
            ]
            starts += [below[name] for name in taken if os.path.islink(below[name])]
            folders[:] = taken
            yield place, names


def _refuse(error: OSError) -> None:
    raise RequestError(f"{error.filename}: this folder cannot be read: {error.strerror}") from None


@dataclass(frozen=True)
class Shard:
    """One part of a run: every ``of``-th job or tar, from the ``number``-th on, counted from 1."""

    number: int = 1
    of: int = 1

    def take(self, jobs: Sequence[T]) -> list[T]:
        """The items of this part.

        >>> [job.key for job in Shard(2, 3).take([Job(Path(k), k) for k in "abcde"])]
        ['b', 'e']
        """
        return list(jobs[self.number - 1 :: self.of])


def parse_shard(text: str) -> Shard:
    """A shard from I/N.

    >>> parse_shard("2/3")
    Shard(number=2, of=3)

    Raises:
        RequestError: the text does not have that form.
    """
    number, of = map(whole_number, text.partition("/")[::2])
    if not 1 <= number <= of <= 1_000_000:
        raise RequestError(f"--shard: found {text!r}; expected I/N, such as 1/8, I from 1 to N")
    return Shard(number, of)
