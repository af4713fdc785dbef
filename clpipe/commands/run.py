"""``clpipe run``: images through the chain, on this machine or on a cluster."""

import logging
import sys
import threading
from collections.abc import Iterator, Mapping, Sequence
from contextlib import closing, contextmanager, nullcontext, suppress
from pathlib import Path
from typing import Any

import click
from rich.console import Console

from clpipe.base.about import full_version
from clpipe.base.errors import ImageError, RequestError
from clpipe.base.memory import parse_size
from clpipe.batch.dask_worker import RunSpec
from clpipe.batch.replay import Replay, replay_of
from clpipe.batch.run_log import RunLog, Summary, log_name
from clpipe.batch.tars import Tar, cut
from clpipe.batch.trace import Trace, check_trace
from clpipe.chain.chain import Chain
from clpipe.chain.identity import MAX_FRAMES
from clpipe.chain.rendition import BASELINES, TRUTHS, parse_bracket
from clpipe.chain.request import Request
from clpipe.commands.chain_options import (
    carry_option,
    companion_option,
    depth_png_option,
    format_option,
    keep_option,
    patch_options,
    series_options,
)
from clpipe.commands.input_options import (
    exclude_option,
    layer_option,
    max_pixels_option,
    poses_option,
    transfer_option,
)
from clpipe.commands.options import Command, options_set, raw_size_option, raw_type_option
from clpipe.commands.poses import views_behind
from clpipe.commands.progress import Reporter
from clpipe.commands.running import batch_of, follow
from clpipe.images.read import PICTURE_SUFFIXES
from clpipe.inputs.find import Job, Shard, find_jobs, parse_shard
from clpipe.inputs.loader import ImageLoader
from clpipe.inputs.poses import with_views
from clpipe.inputs.series import Series, parse_isos
from clpipe.outputs.existing import Resuming
from clpipe.outputs.folder import output_folder, remove_unfinished
from clpipe.outputs.gone import pictures_without_input
from clpipe.outputs.patches import PER_IMAGE
from clpipe.outputs.writer import OutputWriter
from clpipe.stage import Kind


@click.command("run", cls=Command)
@click.argument("inputs", nargs=-1, metavar="INPUT...")
@click.option(
    "-o",
    "--output",
    required=True,
    callback=lambda _context, _option, text: folder_named(text),
    metavar="OUT",
    help="The output folder; it is made where it is missing.",
)
@series_options
@click.option(
    "--frames",
    type=click.IntRange(1, MAX_FRAMES),
    metavar="N",
    help="Make a burst of N frames of each image, each with its own noise, and their truth.",
)
@click.option(
    "--bracket",
    callback=lambda _context, _option, text: () if text is None else parse_bracket(text),
    metavar="EV,EV,...",
    help="Make an exposure of each image for each of these EVs, which are added to exposure.ev; "
    "each has its own noise, and its own frames and truths.",
)
@click.option(
    "--truth",
    "truths",
    multiple=True,
    type=click.Choice(TRUTHS),
    help="Write beside each picture its truth: the same development without noise, the clean "
    "picture (without noise and denoising), its mosaic without noise, or the variance of the noise "
    "in the mosaic; may be repeated.",
)
@click.option(
    "--baseline",
    "baselines",
    multiple=True,
    type=click.Choice(BASELINES),
    help="Write beside each picture the clean one with independent noise of the same strength, "
    "the same everywhere (iid) or following intensity; and the truths that it is made of. May be "
    "repeated.",
)
@raw_size_option
@raw_type_option
@transfer_option
@layer_option
@max_pixels_option
@exclude_option
@poses_option
@keep_option
@carry_option
@companion_option
@depth_png_option
@format_option
@patch_options
@click.option(
    "--keep-suffix",
    is_flag=True,
    help="Name outputs by the input's whole name (a.cr2.jpg, not a.jpg), where a folder has a.cr2 "
    "and a.cr3.",
)
@click.option(
    "--device",
    "selectors",
    multiple=True,
    metavar="SEL",
    help="An index or a part of a name from 'clpipe devices', or numpy; may be repeated. [default: "
    "the first GPU and all of its kind, else the CPU]",
)
@click.option(
    "--memory",
    metavar="SIZE",
    help="Memory of a device, such as 2G; larger images are done in tiles. [default: what is free]",
)
@click.option(
    "--jobs",
    "threads",
    type=click.IntRange(1, 1024),
    metavar="N",
    help="Threads that decode, and as many that encode. [default: one for each processor]",
)
@click.option(
    "--shard",
    default="1/1",
    metavar="I/N",
    callback=lambda _context, _option, text: parse_shard(text),
    help="Do only part I of N of the images, for job arrays.",
)
@click.option(
    "--replay",
    type=click.Path(path_type=Path),
    metavar="SIDECAR",
    help="Make a sidecar's picture again, byte for byte; INPUT is its input, where that moved.",
)
@click.option(
    "--webdataset",
    "per_tar",
    type=click.IntRange(1),
    metavar="N",
    help="Pack N images at a time into OUT/000000.tar and so on, for WebDataset.",
)
@click.option(
    "--dask",
    metavar="ADDRESS",
    help="Run on the workers of a Dask scheduler (tcp://HOST:8786); they must see the same files.",
)
@click.option("--overwrite", is_flag=True, help="Make pictures again that are up to date.")
@click.option(
    "--verify",
    is_flag=True,
    help="Read all pictures that are up to date, and make those again that are damaged.",
)
@click.option(
    "--keep-old",
    is_flag=True,
    help="Keep pictures that another clpipe has made, which are else made again.",
)
@click.option("--quiet", is_flag=True, help="Print failures only.")
@click.option(
    "--json-lines",
    is_flag=True,
    help="Print the lines of the log on stdout, for programs: the start, each image, the end.",
)
@click.option(
    "--trace",
    type=click.Path(path_type=Path),
    metavar="FILE.json",
    help="Write a timeline of the run, for Perfetto or chrome://tracing.",
)
def run(
    inputs: tuple[str, ...],
    output: Path,
    cameras: tuple[str, ...],
    isos: str | None,
    max_pixels: int,
    exclude: tuple[str, ...],
    poses: Path | None,
    keep_suffix: bool,
    selectors: tuple[str, ...],
    memory: str | None,
    threads: int | None,
    shard: Shard,
    replay: Path | None,
    per_tar: int | None,
    dask: str | None,
    overwrite: bool,
    verify: bool,
    keep_old: bool,
    quiet: bool,
    json_lines: bool,
    trace: Path | None,
    **options: Any,
) -> None:
    """Run images through the chain: files, folders, globs or manifests (.csv, .jsonl).

    Renders are linear float images (EXR). Camera raws are developed as they are: they enter at
    normalize, behind the stages that add noise.

    Each image makes OUT/NAME.jpg and OUT/NAME.json, the sidecar with everything that was used. A
    second run makes only what is missing or has changed. OUT/run.jsonl is the log. With --frames:
    OUT/NAME.frame0.jpg and so on, and OUT/NAME.truth.jpg, the same without noise. With --bracket
    -2,0,2: OUT/NAME.ev-2.jpg, OUT/NAME.ev+0.jpg and OUT/NAME.ev+2.jpg. With --webdataset these are
    in tars, and dots in NAME become "_", because a key of WebDataset has none.

    --truth clean is OUT/NAME.truth_clean.jpg, the picture to train on: without noise, and without
    denoising and what else follows from the noise. --truth development is OUT/NAME.truth.jpg, also
    without --frames: denoised as strongly as the noisy picture, so that their difference is the
    noise that is left. --truth mosaic is OUT/NAME.truth_mosaic.exr, the truth of --keep normalize.
    --carry Depth --carry IndexOB writes OUT/NAME.carried.exr with these layers as they are in the
    picture after all that moves its pixels, and a channel "valid": 0 where the render has nothing.
    Depth and labels are those of the nearest pixel, the vectors of flow end where the picture has
    their ends.

    --truth variance is OUT/NAME.truth_variance.exr: for each pixel of that mosaic the variance of
    the noise that the chain adds, in signal squared. It includes what is fixed to a sensor (PRNU,
    DSNU, columns) and rounding, but neither clipping nor defect pixels.
    """
    if quiet:
        logging.getLogger("clpipe").setLevel(logging.WARNING)
    # A checkout asks git for the version that log and sidecars have; here nobody waits for that.
    threading.Thread(target=full_version, daemon=True).start()
    tars: list[Tar] = []
    series = Series(cameras, parse_isos(isos) if isos is not None else ())
    if replay:
        check_beside_replay()
        paths = [Path(path) for path in inputs]
        again = replay_of(replay, paths, max_pixels, options["stage_files"])
        request, jobs = again.request, [again.job]
        loader = ImageLoader(request)
        try:
            chain = loader.first_chain(jobs)
        except RequestError as error:
            raise RequestError(f"{replay}: {error}") from None
    else:
        options |= {"patches_per_image": patch_count_of(options)}
        request = Request.from_options(
            camera=series.camera, iso=series.iso, max_pixels=max_pixels, **options
        )
        loader = ImageLoader(request)
        found = find_jobs(inputs, output, loader.endings(), exclude, keep_suffix)
        jobs = with_views(loader.exposures(found), poses, loader.settings.render)
        jobs = series.jobs(jobs, loader.settings)
        tars = shard.take(cut(jobs, per_tar, output)) if per_tar else []
        jobs = [job for tar in tars for job in tar.jobs] if per_tar else shard.take(jobs)
        if not jobs:
            click.echo(f"shard {shard.number} of {shard.of} has no images", err=True)
            return
        loader.check(jobs)
        chain = loader.first_chain(jobs)
        check_read_options(request, chain)
        request = request.with_outputs(chain)
    writer = OutputWriter(output, request)
    writer.check(chain, jobs)
    if trace:
        check_trace(trace)
    spec = RunSpec(
        request,
        output,
        selectors,
        parse_size(memory) if memory else None,
        threads,
        Resuming(overwrite, verify, keep_old),
        trace is not None,
        first=jobs[0],
    )
    opened = batch_of(spec, loader, chain, tars, dask)
    summary = Summary(len(jobs))  # counts seconds from here on
    reporter = Reporter(summary, writer, Console(stderr=True), quiet or json_lines, keep_old)
    is_whole = not (replay or tars or shard.of > 1)
    with (
        opened as batch,
        output_folder(output, shard),
        views_behind(series.under(output), summary, quiet) if poses and is_whole else nullcontext(),
        gone_behind(writer, jobs, inputs)
        if is_whole and not (quiet or json_lines)
        else nullcontext(),
        Trace(trace) if trace else nullcontext() as timeline,
    ):
        remove_unfinished(output, jobs, request.patch is not None)
        start = {"arguments": sys.argv[1:], "images": len(jobs)}
        log = RunLog(output / log_name(shard), start, print_line if json_lines else None)
        with closing(log):
            follow(batch, jobs, summary, reporter, log, timeline)
    if summary.interrupted:
        sys.exit(130)
    failed = summary.failures or summary.is_fruitless
    sys.exit(1 if failed or (replay and not is_the_same(again, writer)) else 0)


@contextmanager
def gone_behind(writer: OutputWriter, jobs: Sequence[Job], inputs: Sequence[str]) -> Iterator[None]:
    """Say behind a run how many pictures are there whose inputs are not."""
    yield
    if count := pictures_without_input(writer, jobs, inputs):
        pictures, are = ("picture", "is") if count == 1 else ("pictures", "are")
        there = f"{count} {pictures} in {writer.folder} {are} of inputs that are not there any more"
        click.echo(there, err=True)


def print_line(line: bytes) -> None:
    """Print a line on stdout. One that cannot be printed ends no run."""
    with suppress(OSError):
        click.echo(line, nl=False)


def patch_count_of(options: Mapping[str, Any]) -> Any:
    """How many patches of an image, or "grid"; 0 is none.

    Raises:
        RequestError: they are set, but no patches are asked for.
    """
    patch, count, augment = (options[n] for n in ("patch", "patches_per_image", "augment"))
    if patch is None and (count is not None or augment):
        option = "--augment" if augment else "--patches-per-image"
        raise RequestError(f"{option}: it is about patches; say --patch SIZE as well")
    return 0 if patch is None else count or PER_IMAGE


def check_read_options(request: Request, chain: Chain) -> None:
    """See that options about renders are not set for other images.

    Raises:
        RequestError: one is.
    """
    for option, value in (("--layer", request.layer), ("--transfer", request.transfer)):
        if value is not None and chain.source is not Kind.RGB:
            raise RequestError(
                f"{option}: it is for renders, but the chain reads {chain.source.label}"
            )


def is_the_same(replay: Replay, writer: OutputWriter) -> bool:
    """Say whether a replay has made the bytes that its sidecar lists."""
    (rendition,) = writer.renditions_of(replay.job)
    existing = writer.existing(replay.job, rendition)
    try:
        same, text = replay.comparison(existing.sidecar)
    except ImageError as error:
        raise RequestError(str(error)) from None
    click.echo(f"{existing.pictures[0]}: {text}", err=True)
    return same


def folder_named(text: str) -> Path:
    """The output folder.

    Raises:
        RequestError: the name is empty, or that of a picture.
    """
    if not text:
        raise RequestError("--output: it is empty; name a folder")
    folder = Path(text)
    if folder.suffix.lower() in (*PICTURE_SUFFIXES, ".dng") and not folder.is_dir():
        raise RequestError(
            f"--output: found {text}, the name of a picture; name the folder to write to: -o FOLDER"
        )
    return folder


# Options that a sidecar does not store.
BESIDE_REPLAY = (
    *("inputs", "output", "replay", "stage_files", "max_pixels", "selectors", "memory"),
    *("overwrite", "verify", "keep_old", "quiet", "trace"),
)


def check_beside_replay() -> None:
    """See that no option is set whose value comes from the sidecar.

    Raises:
        RequestError: one is.
    """
    for name, option in options_set().items():
        if name not in BESIDE_REPLAY:
            raise RequestError(f"{option}: the sidecar says it; --replay repeats that")
