"""Exposures rendered as several frames: groups the frames, and averages them one at a time."""

import os
from collections.abc import Callable, Sequence
from dataclasses import replace
from itertools import groupby
from pathlib import Path

import numpy as np

from clpipe.base.digests import joint_digest
from clpipe.base.errors import ImageError, RequestError
from clpipe.base.reading import check_unchanged
from clpipe.base.types import Array, Doubles, Floats
from clpipe.chain.registry import stage_in
from clpipe.chain.settings import Settings
from clpipe.images.read import SourceImage
from clpipe.inputs.jobs import Job
from clpipe.inputs.sequences import by_pattern, numbers_of
from clpipe.reference.geometry import Margins
from clpipe.stage import Span, StageRole
from clpipe.stages.shutter import Rows

ROWS = 64  # rows that are added at a time, so that their products take little memory


def shutter_of(settings: Settings) -> Rows | None:
    """Return the shutter if it averages files or makes a light layer flicker, otherwise None.

    Raises:
        RequestError: the number of sub-frames is drawn at random.
    """
    name = stage_in(StageRole.SHUTTER).name
    if name not in settings.step_names:
        return None
    if f"{name}.subframes" in settings.draws:
        raise RequestError(
            f"{name}.subframes: found a random draw, but files are grouped by this number; set one "
            "whole number"
        )
    shutter = settings.method(name)
    if not isinstance(shutter, Rows):
        return None
    return shutter if shutter.subframes > 1 or shutter.light_layer else None


def exposures(jobs: Sequence[Job], settings: Settings, in_sequences: bool = False) -> list[Job]:
    """Return the jobs, with the sub-frames of one exposure joined into one job.

    Consecutive files of one folder form an exposure, which has the name of the first. The same
    holds for consecutive rows of a manifest, whose values must be equal.

    Args:
        jobs: a job for each file.
        settings: the settings with the shutter.
        in_sequences: whether files follow each other in the order of the numbers in their names.

    Raises:
        RequestError: the number of files in a folder is not a multiple of the number of sub-frames,
            rows differ, or a sequence lacks a file.
    """
    shutter = shutter_of(settings)
    if shutter is None or shutter.subframes == 1 or any(job.subframes for job in jobs):
        return list(jobs)
    count = shutter.subframes
    joined = []
    by_folder = groupby(jobs, lambda job: job.path.parent)
    groups = by_pattern(jobs).values() if in_sequences else (each for _, each in by_folder)
    what = "sequence" if in_sequences else "folder"
    for group in groups:
        files = list(group)
        folder = f"{files[0].label} and others" if in_sequences else files[0].path.parent
        if len(files) % count:
            raise RequestError(
                f"{folder}: {stage_in(StageRole.SHUTTER).name}.subframes is {count}, but this "
                f"{what} has {len(files)} image{'s' * (len(files) != 1)}; provide a multiple of "
                f"{count}"
            )
        for start in range(0, len(files), count):
            first, *others = files[start : start + count]
            check_values([first, *others], "a part of the same exposure")
            if in_sequences:
                _check_numbers([first, *others])
            joined.append(replace(first, subframes=tuple(job.path for job in others)))
    return joined


def average(
    job: Job,
    read: Callable[[Path, str | None], SourceImage],
    shutter: Rows,
    spans: tuple[Span, ...],
) -> SourceImage:
    """Return the image of an exposure: for each row, the mean of the frames while it is exposed.

    One frame at a time is in memory, and a float32 sum for each exposure.

    Args:
        job: the job, with the files of all frames.
        read: reads a file, or one layer of it.
        shutter: weights the frames for each row. The first frame may state the exposure time.
        spans: the exposures of a sensor that takes several in a row.

    Raises:
        ImageError: a frame cannot be read, is not in linear light, or has another size.
    """
    found: list[SourceImage] = []  # without pixels
    # For each of ``spans``, the weights of a frame, and extra weights of its light layer.
    weights: list[tuple[Doubles, Doubles]] = []
    totals: Floats = np.empty(0, np.float32)
    for number, path in enumerate(job.paths):
        with check_unchanged(path):
            source = read(path, None)
            light = read(path, shutter.light_layer) if shutter.light_layer else None
        pixels = source.pixels
        if pixels.ndim != 3:
            raise ImageError(
                f"{path}: this is a mosaic, but only renders can be sub-frames; set "
                f"{stage_in(StageRole.SHUTTER).name}.subframes=1"
            )
        if not found:
            weights = _weights_of_spans(job, source, shutter, spans)
            totals = np.zeros((len(spans), *pixels.shape), np.float32)
        elif source.wavelengths != found[0].wavelengths:
            raise _other_bands(path, job)
        elif (pixels.shape, source.margins) != (totals.shape[1:], found[0].margins):
            raise ImageError(
                f"{path}: the size of this frame is {_size(source, pixels)}, but {job.path}, in "
                f"the same exposure, has {_size(found[0], totals[0])}; render all frames at one "
                "size"
            )
        if light and light.wavelengths != source.wavelengths:
            raise _other_bands(path, job)
        for total, (unlit, extra) in zip(totals, weights, strict=True):
            add_frame(total, unlit[number], pixels)
            if light:
                add_frame(total, extra[number], light.pixels)
        warnings = (*source.warnings, *(light.warnings if light else ()))
        found.append(replace(source, pixels=np.empty(0, pixels.dtype), warnings=warnings))
        del source, light, pixels  # before the next frame is read
    averaged = replace(found[0], pixels=totals[0], later=tuple(totals[1:]))
    return with_file_records(averaged, job, found)


def _other_bands(path: Path, job: Job) -> ImageError:
    return ImageError(
        f"{path}: its spectral bands are not those of {job.path}, in the same exposure; render all "
        "frames with the same bands"
    )


def _weights_of_spans(
    job: Job, first: SourceImage, shutter: Rows, spans: tuple[Span, ...]
) -> list[tuple[Doubles, Doubles]]:
    """Return for each exposure the weights of frames, and extra weights of their light layers."""
    shutter = shutter.with_defaults(exposure_time=first.shot.get("exposure_time"))
    size = len(job.paths), first.pixels.shape[0], first.margins
    weights = []
    for number in range(len(spans)):
        sub_shutter = shutter.for_exposure(spans, number)
        unlit, lit = (weights_of(sub_shutter, *size, lit=is_lit) for is_lit in (False, True))
        weights.append((unlit, lit - unlit))
    return weights


def with_file_records(image: SourceImage, job: Job, sources: Sequence[SourceImage]) -> SourceImage:
    """Return an image made of a job's files, with their digests and the warnings of each.

    The image of a single file is returned unchanged.
    """
    if len(sources) == 1:
        return image
    digests = [source.sha256 for source in sources]
    names = (os.path.relpath(path, job.path.parent) for path in job.paths)
    warnings = (
        f"{path.name}: {warning}"
        for path, source in zip(job.paths, sources, strict=True)
        for warning in source.warnings
    )
    return replace(
        image,
        sha256=joint_digest(digests),
        warnings=tuple(dict.fromkeys(warnings)),
        subframes=tuple(zip(names, digests, strict=True)),
    )


def check_values(jobs: Sequence[Job], relation: str) -> None:
    """Check that jobs that will be joined have equal values.

    Args:
        jobs: the jobs.
        relation: what their files have in common, for the message.

    Raises:
        RequestError: the values differ.
    """
    first = jobs[0]
    if different := next((job for job in jobs if job.values != first.values), None):
        raise RequestError(
            f"{different.label}: its values differ from those of {first.label}, but both are "
            f"{relation}; give both the same values"
        )


def _check_numbers(jobs: Sequence[Job]) -> None:
    """Check that one number in the names of sub-frames counts them, without gaps.

    Raises:
        RequestError: it does not.
    """
    steps = np.diff([numbers_of(job) for job in jobs], axis=0)
    if steps.size and ((steps != steps[0]).any() or np.count_nonzero(steps[0]) != 1):
        raise RequestError(
            f"{jobs[0].label} to {jobs[-1].label}: {stage_in(StageRole.SHUTTER).name}.subframes is "
            f"{len(jobs)}, but the numbers in the names of these files do not count the sub-frames "
            "of one exposure; add missing files, or give each camera a directory"
        )


def add_frame(total: Floats, weights: Doubles, pixels: Array) -> None:
    """Add an image to a sum, multiplied by a weight for each row."""
    used = np.flatnonzero(weights)
    end = int(used[-1]) + 1 if used.size else 0
    for first in range(int(used[0]) if used.size else 0, end, ROWS):
        rows = slice(first, min(first + ROWS, end))
        total[rows] += weights[rows, None, None].astype(np.float32) * pixels[rows]


def weights_of(
    shutter: Rows, frames: int, rows: int, margins: Margins, lit: bool = False
) -> Doubles:
    """Return the weights of frames for each row, (frame, row); see :meth:`Rows.weights`.

    Overscan rows have the weights of the picture's first or last row, because there are no frames
    from before or after.
    """
    _, height = margins.frame_size(0, rows)
    in_picture = np.clip(np.arange(rows) - margins.top, 0, height - 1)
    return shutter.weights(frames, height, lit)[:, in_picture]


def _size(source: SourceImage, pixels: Array) -> str:
    """Return the size of a picture and its overscan as text."""
    width, height = source.margins.frame_size(*pixels.shape[1::-1])
    overscan = f" with {tuple(source.margins)} px of overscan" if source.margins else ""
    return f"{width}x{height}{overscan}"
