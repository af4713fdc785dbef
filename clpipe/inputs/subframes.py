"""Exposures that a renderer gives as several frames: grouped, and averaged without loading all."""

import os
from collections.abc import Callable, Sequence
from dataclasses import replace
from itertools import groupby
from pathlib import Path

import numpy as np

from clpipe.base.digests import joint_digest
from clpipe.base.errors import ImageError, RequestError
from clpipe.base.reading import unchanged
from clpipe.base.types import Array, Doubles, Floats
from clpipe.chain.registry import stage_in
from clpipe.chain.settings import Settings
from clpipe.images.read import SourceImage
from clpipe.inputs.find import Job
from clpipe.reference.geometry import Margins
from clpipe.stage import Span, StageRole
from clpipe.stages.shutter import Rows


def shutter_of(settings: Settings) -> Rows | None:
    """The shutter that has files averaged, or a layer's light flicker; None where files are taken
    as they are.

    Raises:
        RequestError: how many frames it averages is drawn.
    """
    name = stage_in(StageRole.SHUTTER).name
    if name not in settings.step_names:
        return None
    if f"{name}.subframes" in settings.draws:
        raise RequestError(
            f"{name}.subframes: found a draw; it says how files are grouped, so it is one number"
        )
    shutter = settings.method(name)
    if not isinstance(shutter, Rows):
        return None
    return shutter if shutter.subframes > 1 or shutter.layer_of_light else None


def exposures(jobs: Sequence[Job], settings: Settings) -> list[Job]:
    """The jobs with so many in a row made one as a shutter averages; it is named by the first.

    Files of one folder belong together, in their order; rows of a manifest likewise, which must
    have the same values.

    Raises:
        RequestError: there are too few or too many files in a folder, or rows differ.
    """
    shutter = shutter_of(settings)
    if shutter is None or shutter.subframes == 1 or any(job.subframes for job in jobs):
        return list(jobs)
    count = shutter.subframes
    grouped = []
    for folder, own in groupby(jobs, lambda job: job.path.parent):
        files = list(own)
        if len(files) % count:
            raise RequestError(
                f"{folder}: {stage_in(StageRole.SHUTTER).name}.subframes is {count}, but there are "
                f"{len(files)} images; give a multiple of {count}"
            )
        for start in range(0, len(files), count):
            first, *others = files[start : start + count]
            check_values([first, *others], "a part of the same exposure")
            grouped.append(replace(first, subframes=tuple(job.path for job in others)))
    return grouped


def average(
    job: Job,
    read: Callable[[Path, str | None], SourceImage],
    shutter: Rows,
    spans: tuple[Span, ...],
) -> SourceImage:
    """The exposure of a job: the mean of its frames, for each row over the time that it is exposed.

    One frame is held at a time, beside the sum in float32 of each exposure.

    Args:
        job: its files.
        read: reads one, or a layer of it.
        shutter: which part of each row's exposure a frame stands for; how long that is, the first
            frame may say.
        spans: of the exposures of a sensor that takes several in a row.

    Raises:
        ImageError: one cannot be read, is no picture in linear light, or is of another size.
    """
    found: list[SourceImage] = []
    totals: Floats = np.empty(0, np.float32)
    weights: list[tuple[Doubles, Doubles]] = []  # of all, and of more of the light that flickers
    for number, path in enumerate(job.paths):
        with unchanged(path):
            source = read(path, None)
            light = read(path, shutter.layer_of_light) if shutter.layer_of_light else None
        pixels = source.pixels
        if pixels.ndim != 3:
            raise ImageError(f"{path}: a mosaic; subframes are averaged of renders")
        if not found:
            time = source.shot.get("exposure_time")
            shutter = shutter.with_defaults(exposure_time=time)
            size = len(job.paths), pixels.shape[0], source.margins
            for each in range(len(spans)):
                own = shutter.during(spans, each)
                plain, lit = (weights_of(own, *size, lit=is_lit) for is_lit in (False, True))
                weights.append((plain, lit - plain))
            totals = np.zeros((len(spans), *pixels.shape), np.float32)
        elif (pixels.shape, source.margins) != (totals.shape[1:], found[0].margins):
            raise ImageError(
                f"{path}: it is {_size(source, pixels)}, and {job.path}, a part of the same "
                f"exposure, {_size(found[0], totals[0])}"
            )
        for total, (plain, more) in zip(totals, weights, strict=True):
            _add(total, plain[number], pixels)
            if light:
                _add(total, more[number], light.pixels)
        warnings = (*source.warnings, *(light.warnings if light else ()))
        found.append(replace(source, pixels=pixels[:0], warnings=warnings))
    averaged = replace(found[0], pixels=totals[0], later=tuple(totals[1:]))
    return of_files(averaged, job, found)


def of_files(image: SourceImage, job: Job, sources: Sequence[SourceImage]) -> SourceImage:
    """An image that was made of a job's files, with their digests and what is to be said of each.

    Of one file it has them already.
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


def check_values(jobs: Sequence[Job], why: str) -> None:
    """See that the same is known of jobs that become one.

    Raises:
        RequestError: it differs.
    """
    first = jobs[0]
    if different := next((job for job in jobs if job.values != first.values), None):
        raise RequestError(
            f"{different.label}: its values differ from those of {first.label}, which is {why}"
        )


def _add(total: Floats, weights: Doubles, pixels: Array) -> None:
    """Add an image to a sum, times a number for each row."""
    seen = np.flatnonzero(weights)
    if seen.size:
        rows = slice(int(seen[0]), int(seen[-1]) + 1)
        total[rows] += weights[rows, None, None].astype(np.float32) * pixels[rows]


def weights_of(
    shutter: Rows, frames: int, rows: int, margins: Margins, lit: bool = False
) -> Doubles:
    """The weights of frames for each row, (frame, row); see :meth:`Rows.weights`.

    Rows beyond the picture are exposed with its first or its last one, as frames last no longer.
    """
    _, height = margins.inside(0, rows)
    in_picture = np.clip(np.arange(rows) - margins.top, 0, height - 1)
    return shutter.weights(frames, height, lit)[:, in_picture]


def _size(source: SourceImage, pixels: Array) -> str:
    """The size of a picture in words, with what its image has beyond it."""
    width, height = source.margins.inside(*pixels.shape[1::-1])
    beyond = f" with {tuple(source.margins)} px of overscan" if source.margins else ""
    return f"{width}x{height}{beyond}"
