"""Checks of a run's options, before anything is read or written."""

from pathlib import Path

from clpipe.base.errors import ImageError, RequestError
from clpipe.base.files import check_folder
from clpipe.base.urls import url_of
from clpipe.batch.execution import ExecutionOptions
from clpipe.chain.chain import Chain
from clpipe.chain.request import Request
from clpipe.images.claims import display_size
from clpipe.images.read import PICTURE_SUFFIXES
from clpipe.images.video import VideoOptions
from clpipe.inputs.find import Job
from clpipe.stage import Kind


def check_processes(
    execution: ExecutionOptions, dask: str | None, has_tars: bool, has_clips: bool
) -> None:
    """Check that the number of processes fits the way the run is done.

    Raises:
        RequestError: a cluster does the work, or tars or clips are written.
    """
    if execution.processes is None or execution.processes == 1:
        return
    if dask is not None:
        raise RequestError("--processes: with --dask the cluster's workers are the processes")
    if has_tars or has_clips:
        what = "tar is packed" if has_tars else "clip is encoded"
        raise RequestError(
            f"--processes: a {what} by one process; run several, each with a --shard"
        )


def check_output(folder: Path, per_tar: int | None = None) -> None:
    """Check that the output is a directory, not a picture, and that a URL gets tars.

    Raises:
        RequestError: it is not.
    """
    if (url := url_of(folder)) and not per_tar:
        raise RequestError(
            f"--output: found {url}; only tars are written to a URL, so add --webdataset N"
        )
    if folder.suffix.lower() in (*PICTURE_SUFFIXES, ".dng") and not folder.is_dir():
        raise RequestError(
            f"--output: found {folder}, the name of a picture; name the folder to write to: "
            "-o FOLDER"
        )
    check_folder(folder)


def check_render_options(request: Request, source: Kind) -> None:
    """Check that options for renders are only set for renders.

    Raises:
        RequestError: one is set for another kind of image.
    """
    for option, value in (("--layer", request.layer), ("--transfer", request.transfer)):
        if value is not None and source is not Kind.RGB:
            raise RequestError(
                f"{option}: this option is only for renders, but the chain reads {source.label}"
            )


def check_clip_chain(chain: Chain) -> None:
    """Check that a chain makes pictures, which a clip can contain.

    Raises:
        RequestError: it ends with other images.
    """
    if chain.result is not Kind.DISPLAY:
        raise RequestError(
            f"--until: the chain ends in {chain.result.label}, but a clip contains pictures; "
            "remove --until, or write images to a directory, with --sequence"
        )


def check_clip_size(chain: Chain, job: Job, video: VideoOptions) -> None:
    """Check that a clip can contain pictures of the size of an image's.

    An image that cannot be opened passes, because it fails later. A panorama does as well, because
    it has several files.

    Raises:
        RequestError: the codec cannot store them.
    """
    if job.is_panorama:
        return
    try:
        size = display_size(job.path)
    except ImageError:
        return
    try:
        video.check_size(*chain.size(*size))
    except ImageError as error:
        raise RequestError(f"--codec: {error}") from None
