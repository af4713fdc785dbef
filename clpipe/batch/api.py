"""The Python API of batches: what ``clpipe run`` does, as a function."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Literal

from clpipe.base.errors import RequestError
from clpipe.base.memory import parse_size
from clpipe.base.text import one_of, several
from clpipe.base.types import plain
from clpipe.base.validation import typed
from clpipe.batch.session import Images, Run
from clpipe.batch.where import Where
from clpipe.chain.formats import EVERY_FORMAT, format_named
from clpipe.chain.identity import MAX_FRAMES
from clpipe.chain.rendition import parse_bracket
from clpipe.chain.request import Request
from clpipe.images.pixels import MAX_PIXELS, USUAL_MAX_PIXELS
from clpipe.inputs.find import parse_shard
from clpipe.inputs.series import Series, check_isos
from clpipe.inputs.spool import path_of
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
    camera: Texts = (),
    iso: float | Sequence[float] | Mapping[str, Any] = (),
    start_at: str | None = None,
    until: str | None = None,
    stage_files: Texts = (),
    format: Texts = (),
    keep: Texts = (),
    carry: Texts = (),
    truth: Texts = (),
    frames: int | None = None,
    bracket: Sequence[float] = (),
    patch: int | Patches | None = None,
    exclude: Texts = (),
    poses: str | Path | None = None,
    layer: str | None = None,
    transfer: Literal["srgb", "linear"] | None = None,
    max_pixels: int = USUAL_MAX_PIXELS,
    redo: Literal["missing", "old", "damaged", "all"] = "old",
    webdataset: int | None = None,
    shard: str = "1/1",
    device: str | int | Sequence[str | int] = (),
    memory: int | str | None = None,
    jobs: int | None = None,
    processes: int | None = None,
    dask: str | None = None,
    trace: str | Path | None = None,
    **settings: Any,
) -> Run:
    """Images through a chain, to files: what ``clpipe run`` does, by the same names.

    >>> import clpipe
    >>> made = clpipe.run("renders/", "out", iso=1600, truth="clean")  # doctest: +SKIP
    >>> for outcome in made:  # doctest: +SKIP
    ...     print(outcome.job.path, outcome.status, outcome.outputs)
    >>> made.summary.counts  # doctest: +SKIP
    {'done': 24, 'skipped': 0, 'left out': 0, 'failed': 0}

    Args:
        inputs: files, folders, globs and manifests.
        output: the folder that the pictures go to; it is made where it is missing.
        config: a built-in configuration or a TOML file, or several, each over those before it.
        camera, iso: one, or several, whose pictures go to folders of their own.
        stage_files, format, keep, carry, truth, exclude, device: one, or several.
        memory: of a device, in bytes or as "2G".
        **settings: what a configuration file may hold, over ``config``.
        patch: the sides of patches in px, or with how many and how: ``Patches(128, per_image=4)``.
        start_at, until, frames, bracket, poses, layer, transfer, max_pixels, redo, webdataset,
            shard, jobs, processes, dask, trace: as the options of ``clpipe run``.

    Returns:
        A run that begins when it is iterated.

    Raises:
        RequestError: a name or value that is not allowed, an input that is not there, or a result
            that would overwrite something. One image's failure is its outcome, and no error.
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
    isos = (iso,) if isinstance(iso, int | float) else () if isinstance(iso, Mapping) else iso
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
