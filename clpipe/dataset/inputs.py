"""The inputs of a dataset: its images and the size of its cache."""

import logging
import os
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

from clpipe.base.digests import stamp_of
from clpipe.base.errors import ImageError, RequestError
from clpipe.base.memory import parse_size
from clpipe.base.user_warnings import warn
from clpipe.chain.isos import draw_note
from clpipe.chain.python_words import python_words
from clpipe.inputs.find import Job, find_jobs
from clpipe.inputs.lenses import lens_notes
from clpipe.inputs.loader import ImageLoader

log = logging.getLogger(__name__)

NO_OUTPUT = Path(os.devnull)  # no output is written


def cache_size(cache: int | str) -> int:
    """Return the bytes of a number, or of a text with a unit.

    Raises:
        RequestError: the value is neither.
    """
    try:
        size = parse_size(cache) if isinstance(cache, str) else cache
    except RequestError:
        size = -1
    if size < 0:
        raise RequestError(f"found cache {cache!r}; expected bytes, or a size such as 512M or 4G")
    return size


def jobs_of(
    loader: ImageLoader, inputs: Sequence[str], exclude: Sequence[str], skips: bool
) -> list[Job]:
    """Return the images of a dataset.

    Args:
        loader: reads the images.
        inputs: as for :func:`clpipe.inputs.find.find_jobs`.
        exclude: as for :func:`clpipe.inputs.find.find_jobs`.
        skips: whether to skip files with unreadable headers, with a warning.

    Raises:
        RequestError: there is no image, an input does not exist, a header cannot be read, or two
            images have the same name, and therefore the same draws.
    """
    jobs = loader.exposures(find_jobs(inputs, NO_OUTPUT, loader.endings(), exclude))
    loader.check(jobs)
    if note := draw_note(loader.settings):
        log.info("%s", note)
    for note in lens_notes(loader.settings, jobs):
        log.warning("%s", note)
    job_by_key: dict[str, Job] = {}
    for job in jobs:
        # Files that were found in directories exist.
        if job.named_by_user and stamp_of(job.path) == (0, 0):
            raise RequestError(f"{job.label}: there is no such file or folder")
        other = job_by_key.setdefault(job.key, job)
        if other is not job:
            raise RequestError(
                f"{other.label} and {job.label} have the same name {job.key}, and would get the "
                "same draws. Name the directory that contains both"
            )
    with ThreadPoolExecutor() as threads:
        is_readable = list(threads.map(loader.has_readable_header, jobs))
    damaged = [job for job, readable in zip(jobs, is_readable, strict=True) if not readable]
    if not damaged:
        return jobs
    others = f" (and {len(damaged) - 1} other files)" if len(damaged) > 1 else ""
    text = f"{_reason(loader, damaged[0])}{others}"
    if not skips or len(damaged) == len(jobs):
        raise RequestError(f"{text}. Remove such files, or set on_error='skip'")
    warn(python_words(f"skipped: {text}"))
    return [job for job, readable in zip(jobs, is_readable, strict=True) if readable]


def _reason(loader: ImageLoader, job: Job) -> str:
    """Return why the header of a file cannot be read."""
    try:
        loader.for_job(job).read(job)
    except ImageError as error:
        return str(error)
    return f"{job.path}: its header cannot be read"
