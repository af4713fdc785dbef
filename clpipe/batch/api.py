"""The Python API of batches: what ``clpipe run`` does, as a function."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Literal

from clpipe.base.errors import RequestError
from clpipe.base.memory import parse_size
from clpipe.base.text import one_of, several
from clpipe.base.types import plain
from clpipe.base.urls import path_of
from clpipe.base.validation import typed
from clpipe.batch.session import Images, Run
from clpipe.batch.where import Where
from clpipe.chain.formats import EVERY_FORMAT, format_named
from clpipe.chain.identity import MAX_FRAMES
from clpipe.chain.rendition import parse_bracket
from clpipe.chain.request import Moments, Request
from clpipe.images.pixels import MAX_PIXELS, USUAL_MAX_PIXELS
from clpipe.inputs.find import parse_shard
from clpipe.inputs.series import Series, check_isos
from clpipe.outputs.existing import Redo
from clpipe.outputs.patches import Patches

# The most that may be asked for; the least is 1.
MOST = {
    "frames": MAX_FRAMES,
    "jobs": 1024,
    "processes": 1024,
    "webdataset": 10**6,
    "max_pixels": MAX_PIXELS,
}

Texts = str | Path | Sequence[str | Path]  # one, or several


@typed
def run(
    inputs: Texts,
    output: str | Path,
    config: Texts | None = None,
    *,
    camera: Texts | None = None,
    iso: float | Sequence[float] | Mapping[str, Any] | None = None,
    start_at: str | None = None,
    until: str | None = None,
    stage_files: Texts | None = None,
    format: Texts | None = None,
    keep: Texts | None = None,
    carry: Texts | None = None,
    truth: Texts | None = None,
    truth_at: Moments = "middle",
    frames: int | None = None,
    bracket: Sequence[float] | None = None,
    patch: int | Patches | None = None,
    exclude: Texts | None = None,
    poses: str | Path | None = None,
    layer: str | None = None,
    transfer: Literal["srgb", "linear"] | None = None,
    max_pixels: int = USUAL_MAX_PIXELS,
    redo: Literal["missing", "old", "damaged", "all"] = "old",
    webdataset: int | None = None,
    shard: str = "1/1",
    device: str | int | Sequence[str | int] | None = None,
    memory: int | str | None = None,
    jobs: int | None = None,
    processes: int | None = None,
    dask: str | None = None,
    trace: str | Path | None = None,
    **settings: Any,
) -> Run:
    """Put images through a chain and write the results, like ``clpipe run``.

    >>> import clpipe
    >>> made = clpipe.run("renders/", "out", iso=1600, truth="clean")  # doctest: +SKIP
    >>> for outcome in made:  # doctest: +SKIP
    ...     print(outcome.job.path, outcome.status, outcome.outputs)
    >>> made.summary.counts  # doctest: +SKIP
    {'done': 24, 'skipped': 0, 'left out': 0, 'failed': 0}

    Args:
        inputs: files, folders, globs, URLs and manifests; one, or several.
        output: the output directory or its URL. It is created if it does not exist.
        config: a built-in configuration or a TOML file. If you name several, each overrides those
            before it. None is the default configuration.
        camera: the name of a profile or its TOML file. With several, each camera's pictures go to
            a directory of their own.
        iso: the ISO, or a draw such as ``{"log_uniform": [100, 6400]}``. With several numbers,
            each ISO's pictures go to a directory of their own.
        start_at: the first step to run. Inputs are then images of the kind that this step reads.
        until: the last step to run.
        stage_files: Python files that define further stages.
        format: formats of the pictures, such as "png" or "exr". None is JPEG.
        keep: steps whose image is also written, or "all".
        carry: layers that are warped with the picture, such as "Depth".
        truth: ground truths and baselines to write next to each picture: "development", "clean",
            "mosaic", "variance", "iid", "intensity".
        truth_at: the moment of an exposure of several files whose pose and layers go with the
            picture: "start", "middle", "end", or "all".
        frames: the number of frames of a burst. Each frame has its own noise. None is one picture.
        bracket: one exposure per value, in EV relative to ``exposure.ev``.
        patch: the side of square patches in px, which are written instead of pictures, or
            ``Patches(128, per_image=4, augment=True)``.
        exclude: patterns of files that are skipped in directories and globs.
        poses: a file with the camera and pose of each render, such as ``transforms.json``.
        layer: the layer or part of an EXR that is the picture. None lets clpipe choose.
        transfer: the transfer curve of renders in integers: "srgb" or "linear".
        max_pixels: larger images are rejected before memory is allocated.
        redo: which existing pictures to make again: "missing", "old" (also those of another
            version or request), "damaged" (also damaged files, which reads every file), or "all".
        webdataset: the number of images per tar. None writes files, no tars.
        shard: the part of the images to make, such as "2/8", for job arrays.
        device: an index or part of a name from ``clpipe devices``, or "numpy"; one, or several.
            None is the first GPU and all GPUs like it, else the CPU.
        memory: the memory of a device that clpipe may use, in bytes or such as "2G".
        jobs: the number of threads that decode, and of those that encode.
        processes: the number of processes that share the work.
        dask: the address of a Dask scheduler, whose workers do the work.
        trace: a JSON file for a timeline of the run, for Perfetto or chrome://tracing.
        **settings: any value of a configuration file, which overrides ``config``:
            ``seed=1``, ``denoise={"method": "mean"}``.

    Returns:
        A :class:`Run`. The run starts when you iterate over it, and yields an :class:`Outcome`
        for each image, in any order.

    Raises:
        RequestError: a name or value is not allowed, an input does not exist, or a result would
            overwrite an input. If one image fails, its outcome says so, and the run continues.
    """
    numbers = {
        "frames": frames,
        "jobs": jobs,
        "processes": processes,
        "webdataset": webdataset,
        "max_pixels": max_pixels,
    }
    for name, number in numbers.items():
        if number is not None and not 1 <= number <= MOST[name]:
            raise RequestError(f"found {name} {number}; expected 1 to {MOST[name]}")
    if not str(output):
        raise RequestError("output: it is empty; name a folder")
    formats = tuple(map(format_named, several(format)))
    for each in formats:
        if each not in EVERY_FORMAT:
            raise RequestError(one_of("format", each, EVERY_FORMAT))
    if isinstance(memory, int) and memory < 1:
        raise RequestError(f"found memory {memory}; expected bytes, or a size such as 8G")
    isos: Sequence[float] = ()
    if iso is not None and not isinstance(iso, Mapping):
        isos = (iso,) if isinstance(iso, int | float) else iso
    series = Series(several(camera), check_isos(isos))
    patches = Patches(patch) if isinstance(patch, int) else patch
    values = plain(settings)
    if isinstance(iso, Mapping):
        values["iso"] = plain(iso)
    request = Request.from_options(
        config=config,
        camera=series.camera,
        iso=series.iso,
        stage_files=[Path(file) for file in several(stage_files)],
        values=values,
        start_at=start_at,
        until=until,
        formats=formats,
        keep=several(keep),
        carry=several(carry),
        truth=several(truth),
        truth_at=truth_at,
        frames=frames,
        bracket=parse_bracket(",".join(map(str, bracket))) if bracket else (),
        patch=patches.size if patches else None,
        patches_per_image=patches.per_image if patches else 0,
        augment=bool(patches and patches.augment),
        layer=layer,
        transfer=transfer,
        max_pixels=max_pixels,
    )
    images = Images(
        several(inputs),
        several(exclude),
        None if poses is None else Path(poses),
        series,
        parse_shard(shard),
        webdataset,
    )
    where = Where(
        path_of(str(output)),
        several(device),
        parse_size(memory) if isinstance(memory, str) else memory,
        jobs,
        Redo(redo),
        None if trace is None else Path(trace),
        processes,
    )
    return Run(request, images, where, dask)
