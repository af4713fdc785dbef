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
from clpipe.base.urls import is_glob, is_url, list_urls, path_of, url_of
from clpipe.chain.rendition import Rendition
from clpipe.images.raw import RAW_SUFFIXES
from clpipe.images.read import PICTURE_SUFFIXES, RENDER_SUFFIXES
from clpipe.inputs.companions import owner_of
from clpipe.inputs.manifest import MANIFEST_SUFFIXES, read_manifest

T = TypeVar("T")

log = logging.getLogger(__name__)

# By extension: why a file is not an image, and which option or command takes it.
NO_IMAGES = {
    ".json": "this is JSON, not an image; to recompute a sidecar's picture, use 'clpipe replay'",
    ".toml": "this is a configuration or a camera, not an image; pass it with -c or --camera",
    ".blend": "this is a Blender scene, not an image; to render it, use 'clpipe dataset'",
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
        key: its name among the inputs. Random draws and the names of outputs depend on it.
        name: the path of its outputs in the output directory, without extension; "" uses the key.
        listed: whether the user named it, by path, glob or manifest, rather than by its folder.
        values: settings of this image only, nested like a configuration.
        frames: the number of frames; None uses that of the request.
        place: its manifest and row; "" if it is not in a manifest.
        renditions: the renditions to make; None is all.
        written: the path as the user wrote it, if ``path`` has been made absolute.
        subframes: further files of the same exposure.
        size: the width and height in px that the image must have; None allows any.
        problem: why it cannot be made, if that is known before it is read.
        around: whether its files are views of a panorama and not sub-frames.
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
        """Check that no problem of this job is known.

        Raises:
            ImageError: one is.
        """
        if self.problem:
            raise ImageError(f"{self.label}: {self.problem}")

    @property
    def paths(self) -> tuple[Path, ...]:
        """All files of its exposure, the first one first."""
        return (self.path, *self.subframes)

    def at(self, moment: str) -> Path:
        """Return the file at a moment of its exposure: "start", "middle" or "end".

        The middle of an even number of files is the last file of the first half.
        """
        places = {"start": 0, "middle": (len(self.paths) - 1) // 2, "end": -1}
        return self.paths[places[moment]]

    @property
    def shown(self) -> str:
        """The file's name in messages and logs: its URL if it has one, otherwise its path."""
        return url_of(self.path) or str(self.path)

    @property
    def input(self) -> str:
        """The path that is stored and printed: as the user wrote it, if that is known."""
        return self.written or self.shown

    @cached_property
    def stem(self) -> str:
        """The path of its outputs in the output directory, without extension."""
        return self.name or str(Path(self.key).with_suffix(""))

    @property
    def label(self) -> str:
        """The job's name in errors: its file, with its manifest and row."""
        return f"{self.shown} ({self.place})" if self.place else self.shown


def find_jobs(
    inputs: Sequence[str],
    output: Path,
    endings: Sequence[str] = (*RENDER_SUFFIXES, *RAW_SUFFIXES),
    exclude: Sequence[str] = (),
) -> list[Job]:
    """Return the jobs of a run, in the order of its inputs.

    The key of a file in a folder is its path relative to that folder. The key of a file that is
    named, or matches a glob, is its name. Rows of a manifest have their own keys. A row whose file
    is missing becomes a job that fails later, without affecting others. Companions are not jobs,
    see :func:`without_companions`.

    Args:
        inputs: files, folders (all images in them, at any depth), globs and manifests.
        output: the output directory. If it is inside an input folder, its files are skipped.
        endings: extensions of the files that are taken from folders.
        exclude: patterns of files to skip in folders and globs, see :class:`Exclusion`.

    Raises:
        RequestError: there is no input, an input is empty, a folder has no images or cannot be
            read, no file matches a glob, or a manifest is wrong.
        MissingError: a named file does not exist.
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
                raise RequestError(f"{text}: no file matches this pattern; correct it")
            jobs += [Job(Path(m), Path(m).name) for m in matches if m not in excluded]
        else:
            check_input(path)
            if no_image := NO_IMAGES.get(path.suffix.lower()):
                raise RequestError(f"{path}: {no_image}")
            jobs.append(Job(path, path.name))
    for pattern in excluded.unused:
        log.warning("--exclude %s matches no file", pattern)
    jobs = without_companions(jobs)
    if not jobs:
        raise RequestError("every file is excluded by --exclude; use a narrower pattern")
    return jobs


def without_companions(jobs: Sequence[Job]) -> list[Job]:
    """Return the jobs without companions of other jobs' images, according to their names.

    For example, ``view00_depth.exr`` is skipped if ``view00.exr`` is a job. Files that a manifest
    lists always stay.
    """
    stems = {str(job.path.with_suffix("")) for job in jobs}
    found = [job for job in jobs if not job.place and owner_of(job.path) in stems]
    if found:
        are = "1 file is a companion" if len(found) == 1 else f"{len(found)} files are companions"
        first = printable(str(found[0].path))
        log.info("%s of another image, such as %s; to warp layers, use --carry", are, first)
    others = {id(job) for job in found}
    return [job for job in jobs if id(job) not in others]


class Exclusion:
    """Patterns (* ? []) of what to skip: paths in an input folder, or names of files or folders."""

    def __init__(self, patterns: Sequence[str] = ()) -> None:
        self._patterns = patterns
        self.unused = dict.fromkeys(patterns)  # patterns that have matched nothing so far

    def __bool__(self) -> bool:
        return bool(self._patterns)

    def __contains__(self, path: str) -> bool:
        name = os.path.basename(path)
        matching = [p for p in self._patterns if fnmatchcase(path, p) or fnmatchcase(name, p)]
        for pattern in matching:
            self.unused.pop(pattern, None)
        return bool(matching)


def _jobs_behind(url: str, endings: Sequence[str], excluded: Exclusion) -> list[Job]:
    """Return the jobs of a URL: one file, all images below it, or all files that match a glob.

    Raises:
        RequestError: the URL cannot be listed, or has no images.
    """
    is_pattern = is_glob(url)
    if not is_pattern and Path(url).suffix.lower() in endings:  # one that is missing fails alone
        return [Job(path_of(url), url.rpartition("/")[2])]
    root = url.rstrip("/")
    jobs = []
    for each in list_urls(url):
        is_below = each.startswith(f"{root}/") and not is_pattern
        key = each.removeprefix(f"{root}/") if is_below else each.rpartition("/")[2]
        hidden = any(part.startswith(".") for part in key.split("/"))
        suffix = Path(key).suffix.lower()
        if (is_below and (hidden or suffix not in endings)) or key in excluded:
            continue
        try:
            path = path_of(each)
        except RequestError as error:
            log.warning("%s; this file is skipped", error)
            continue
        jobs.append(Job(path, key, listed=not is_below))
    if not jobs:
        raise RequestError(
            f"{url}: there are no images at this URL; clpipe looked for {', '.join(endings[:6])} "
            "and more"
        )
    return jobs


def images_in(
    folder: Path, output: Path, endings: Sequence[str], excluded: Exclusion
) -> list[Path]:
    """Return the images in a folder, at any depth, sorted. The number of other files is logged.

    Hidden files and the output directory are skipped. A dangling link counts as an image, which
    fails later.

    Raises:
        RequestError: a folder cannot be read, or there are no images.
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
    kinds_text = printable(", ".join(kinds))
    if not images:
        left = " that are not excluded" if excluded else ""
        looked = ", ".join(e for e in endings if e not in RAW_SUFFIXES)
        raws = " and camera raws" if set(RAW_SUFFIXES) & set(endings) else ""
        text = f"{folder}: this folder has no images{left}; clpipe looked for {looked}{raws}"
        text += f", and the folder has {kinds_text}" if kinds_text else ""
        if others.keys() & set(PICTURE_SUFFIXES):
            text += f". {FINISHED}"
        raise RequestError(text)
    if others:
        is_one = others.total() == 1
        not_images = "file is not an image" if is_one else "files are not images"
        were = "was" if is_one else "were"
        log.info(
            "%s: %d %s and %s skipped: %s", folder, others.total(), not_images, were, kinds_text
        )
    return sorted(images)


def _walk(folder: Path, output: Path, excluded: Exclusion) -> Iterator[tuple[str, list[str]]]:
    """Yield each folder below one, with the names of its files. Links are followed last.

    A file that is also reachable through a link therefore gets its path without the link, whatever
    the order on disk.

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
    """A part of a run: every ``of``-th job or tar, starting with the ``number``-th, from 1."""

    number: int = 1
    of: int = 1

    def take(self, jobs: Sequence[T]) -> list[T]:
        """Return the items of this part.

        >>> [job.key for job in Shard(2, 3).take([Job(Path(k), k) for k in "abcde"])]
        ['b', 'e']
        """
        return list(jobs[self.number - 1 :: self.of])


def parse_shard(text: str) -> Shard:
    """Return a shard from a text of the form I/N.

    >>> parse_shard("2/3")
    Shard(number=2, of=3)

    Raises:
        RequestError: the text does not have that form.
    """
    number, of = map(whole_number, text.partition("/")[::2])
    if not 1 <= number <= of <= 1_000_000:
        raise RequestError(f"--shard: found {text!r}; expected I/N with I from 1 to N, such as 1/8")
    return Shard(number, of)
