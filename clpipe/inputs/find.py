"""Finds the images of a run in files, folders, globs and manifests, and names their outputs."""

import glob
import logging
import os
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TypeVar

from clpipe.base.errors import ImageError, RequestError
from clpipe.base.reading import check_input
from clpipe.base.text import printable, whole_number
from clpipe.base.url_text import is_glob, is_url, local, name_in
from clpipe.base.urls import forget_stamps, list_urls, path_of, url_of
from clpipe.chain.python_words import python_words
from clpipe.images.clip_frames import clip_of, clip_times, frame_path
from clpipe.images.raw import RAW_SUFFIXES
from clpipe.images.read import RENDER_SUFFIXES
from clpipe.images.video_reading import VIDEO_SUFFIXES
from clpipe.inputs.companions import owner_of
from clpipe.inputs.folders import FINISHED, Exclusion, images_in, summary_of
from clpipe.inputs.jobs import Job, Place
from clpipe.inputs.manifest import MANIFEST_SUFFIXES, read_manifest
from clpipe.inputs.numbered import numbered_files

__all__ = ["Job", "Place", "Shard", "find_jobs", "parse_shard", "without_companions"]

T = TypeVar("T")

log = logging.getLogger(__name__)

# For each extension, why a file is not an image, and which option or command reads it.
NON_IMAGES = {
    ".json": "this is JSON, not an image; to recompute a sidecar's picture, use 'clpipe replay'",
    ".toml": "this is a configuration or a camera, not an image; pass it with -c or --camera",
    ".zip": "this is an archive; to develop all images in it, name zip://::FILE.zip",
    ".tar": "this is an archive; to develop all images in it, name tar://::FILE.tar",
    ".blend": "this is a Blender scene, not an image; to render it, use 'clpipe dataset'",
}


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
        inputs: files, clips, folders (all images in them, at any depth), globs, patterns of
            numbered files and manifests.
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
    forget_stamps()
    for text in map(local, inputs):
        if not text:
            raise RequestError("an input is empty; give files, folders, globs or manifests")
        path = path_of(text)
        if is_url(text) and path.suffix.lower() not in MANIFEST_SUFFIXES:
            jobs += _jobs_at_url(text, endings, excluded)
        elif os.path.isdir(text):
            files = images_in(path, output, endings, excluded)
            jobs += [Job(p, p.relative_to(path).as_posix(), named_by_user=False) for p in files]
        elif path.suffix.lower() in MANIFEST_SUFFIXES:
            jobs += read_manifest(path)
        elif (matches := numbered_files(text) or glob_files(text)) is not None:
            jobs += [Job(Path(m), Path(m).name) for m in matches if m not in excluded]
        else:
            clip = clip_of(path)
            check_input(clip or path)
            if reason := NON_IMAGES.get(path.suffix.lower()):
                raise RequestError(f"{path}: {reason}")
            jobs.append(Job(path, f"{clip.stem}/{path.name}" if clip else path.name))
    for pattern in excluded.unused:
        log.warning(python_words("--exclude %s matches no file"), pattern)
    jobs = [frame for job in without_companions(jobs) for frame in _frames(job, endings)]
    if not jobs:
        raise RequestError("every file is excluded by --exclude; use a narrower pattern")
    return jobs


def _frames(job: Job, endings: Sequence[str]) -> Iterator[Job]:
    """Yield the jobs of a clip's frames, with their times, or a job of another file itself.

    Raises:
        RequestError: the chain starts on linear light, the clip is at a URL, or PyAV is missing.
    """
    path = job.path
    if path.suffix.lower() not in VIDEO_SUFFIXES:
        yield job
        return
    if job.location:
        raise RequestError(
            f"{job.location}: {path.name} is a clip; list its frames, such as "
            f"{frame_path(Path(path.name), 0).as_posix()}, or give the clip as an input"
        )
    if path.suffix.lower() not in endings:
        raise RequestError(f"{path}: this is a clip. {FINISHED}")
    if url_of(path):
        raise RequestError(f"{job.display_name}: a clip at a URL is not read; copy it here")
    try:
        times = clip_times(path)
    except ImageError as error:
        yield replace(job, problem=str(error).removeprefix(f"{path}: "))
        return
    if not times:
        yield replace(job, problem="this clip has no frames")
    for number, time in enumerate(times):
        name = frame_path(Path(job.key).with_suffix(""), number).as_posix()
        yield replace(job, path=frame_path(path, number), key=name, time=time)


def glob_files(text: str) -> list[str] | None:
    """Return the files that a glob matches; None if the text is no glob, or names a file.

    Raises:
        RequestError: no file matches.
    """
    if not glob.has_magic(text) or os.path.exists(text):
        return None
    matches = sorted(m for m in glob.glob(text, recursive=True) if os.path.isfile(m))
    if not matches:
        raise RequestError(f"{text}: no file matches this pattern; correct it")
    return matches


def without_companions(jobs: Sequence[Job]) -> list[Job]:
    """Return the jobs without companions of other jobs' images, according to their names.

    For example, ``view00_depth.exr`` is skipped if ``view00.exr`` is a job, and the files of a
    folder ``film_depth`` if ``film.mp4`` is one. Files that a manifest lists always stay.
    """
    stems = {str(job.path.with_suffix("")) for job in jobs}
    clips = {str(j.path.with_suffix("")) for j in jobs if j.path.suffix.lower() in VIDEO_SUFFIXES}
    found = [
        job
        for job in jobs
        if not job.location
        and (owner_of(job.path) in stems or (clips and owner_of(job.path.parent) in clips))
    ]
    if found:
        are = "1 file is a companion" if len(found) == 1 else f"{len(found)} files are companions"
        first = printable(str(found[0].path))
        text = python_words("%s of another image, such as %s; to warp layers, use --carry")
        log.info(text, are, first)
    skipped_types = {id(job) for job in found}
    return [job for job in jobs if id(job) not in skipped_types]


def _jobs_at_url(url: str, endings: Sequence[str], excluded: Exclusion) -> list[Job]:
    """Return the jobs of a URL: one file, all images below it, or all files that match a glob.

    Raises:
        RequestError: the URL cannot be listed, or has no images.
    """
    is_pattern = is_glob(url)
    # If the file is missing, only its job fails.
    inner = name_in(url)
    if not is_pattern and Path(inner).suffix.lower() in endings:
        return [Job(path_of(url), inner.rpartition("/")[2])]
    root = inner if inner.endswith("/") else f"{inner}/"
    jobs: list[Job] = []
    skipped: Counter[str] = Counter()
    for each in list_urls(url):
        name = name_in(each)
        is_below = name.startswith(root) and not is_pattern
        key = name.removeprefix(root) if is_below else name.rpartition("/")[2]
        suffix = Path(key).suffix.lower()
        if key in excluded:
            continue
        try:
            path = path_of(each)
            is_hidden = any(part.startswith(".") for part in key.split("/"))
            if is_below and (is_hidden or suffix not in endings):
                skipped["hidden" if is_hidden else suffix or "without suffix"] += 1
                continue
        except RequestError:
            skipped["with '..', '.' or empty parts in the key"] += 1
            continue
        jobs.append(Job(path, key, named_by_user=not is_below))
    summary = summary_of(skipped)
    if not jobs:
        text = f"{url}: there are no images at this URL; clpipe looked for "
        text += f"{', '.join(endings[:6])} and more"
        raise RequestError(text + f", and found {summary}" * bool(summary))
    if skipped:
        log.info("%s: other files were skipped: %s", url, summary)
    return jobs


@dataclass(frozen=True)
class Shard:
    """A part of a run: every ``of``-th job or tar, starting with the ``number``-th, from 1."""

    number: int = 1
    of: int = 1

    def __str__(self) -> str:
        return f"{self.number}/{self.of}"

    def select(self, jobs: Sequence[T]) -> list[T]:
        """Return the items of this part.

        >>> [job.key for job in Shard(2, 3).select([Job(Path(k), k) for k in "abcde"])]
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
