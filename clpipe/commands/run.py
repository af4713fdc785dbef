"""TODO."""

import sys
from collections.abc import Sequence
from contextlib import AbstractContextManager, closing, nullcontext
from pathlib import Path
from typing import Any

import click
from click.core import ParameterSource
from rich.console import Console

from clpipe.base.errors import RequestError
from clpipe.base.memory import parse_size
from clpipe.batch.dask_client import Cluster, connected
from clpipe.batch.dask_worker import RunSpec
from clpipe.batch.interrupt import interruptible
from clpipe.batch.replay import replay_of
from clpipe.batch.run_log import RunLog, Summary, log_name
from clpipe.batch.tars import Tar, TarBatch, cut
from clpipe.batch.threads import Batch
from clpipe.batch.trace import Trace, check_trace
from clpipe.chain.chain import Chain
from clpipe.chain.request import request_from_options
from clpipe.commands.options import chain_options, format_option, keep_option
from clpipe.commands.progress import Reporter
from clpipe.engine.device import Device, open_devices
from clpipe.images.dump import TYPES
from clpipe.images.read import MAX_PIXELS, TRANSFERS, USUAL_MAX_PIXELS, ReadOptions
from clpipe.inputs.find import Shard, find_jobs, parse_shard
from clpipe.inputs.loader import ImageLoader
from clpipe.outputs.folder import output_folder, remove_unfinished
from clpipe.outputs.renditions import TRUTHS, RenditionPlan
from clpipe.outputs.writer import OutputWriter
from clpipe.stage import Kind


@click.command("run")
@click.argument("inputs", nargs=-1, metavar="INPUT...")
@click.option(
    "-o",
    "--output",
    required=True,
    callback=lambda _context, _option, text: folder_named(text),
    metavar="OUT",
    help="The folder for what comes out; made if need be.",
)
@chain_options
@click.option(
    "--frames",
    type=click.IntRange(1),
    metavar="N",
    help="Make a burst of N frames of each image, each with noise of its own, and the truth.",
)
@click.option(
    "--truth",
    "truths",
    multiple=True,
    type=click.Choice(TRUTHS),
    help="Make beside each picture what is known of it: its development or its mosaic without "
    "noise, or the variance of the noise in the mosaic; may be repeated.",
)
@click.option("--raw-size", metavar="WxH", help="Of headerless dumps (.raw): width and height.")
@click.option(
    "--raw-type", type=click.Choice(list(TYPES)), help="And how their samples are stored."
)
@click.option(
    "--transfer",
    type=click.Choice(list(TRANSFERS)),
    help="Of renders in whole numbers (PNG, TIFF of 8 or 16 bits), which do not say it.",
)
@click.option("--layer", metavar="NAME", help="The layer or part of an EXR that is the picture.")
@click.option(
    "--max-pixels",
    default=USUAL_MAX_PIXELS,
    show_default=True,
    type=click.IntRange(1, MAX_PIXELS),
    metavar="N",
    help="Refuse files that claim more, before memory is taken.",
)
@keep_option
@format_option
@click.option(
    "--device",
    "selectors",
    multiple=True,
    metavar="SEL",
    help="An index or a part of a name from 'clpipe devices', or numpy; may be repeated. [default: "
    "the first GPU and all of its kind, else the first CPU]",
)
@click.option(
    "--memory",
    metavar="SIZE",
    help="Of a device, such as 2G; larger images go in tiles. [default: what is free]",
)
@click.option(
    "--jobs",
    "threads",
    type=click.IntRange(1, 1024),
    metavar="N",
    help="Images that are decoded at a time, and as many encoded. [default: one a processor]",
)
@click.option(
    "--shard",
    default="1/1",
    metavar="I/N",
    callback=lambda _context, _option, text: parse_shard(text),
    help="Do the I-th of N parts of the images, for job arrays.",
)
@click.option(
    "--replay",
    type=click.Path(path_type=Path),
    metavar="SIDECAR",
    help="Make the picture of a sidecar again, the same bytes; an INPUT is where its input is now.",
)
@click.option(
    "--webdataset",
    "per_tar",
    type=click.IntRange(1),
    metavar="N",
    help="Pack N images at a time into OUT/000000.tar and so on, as WebDataset reads them.",
)
@click.option(
    "--dask",
    metavar="ADDRESS",
    help="Of a Dask scheduler (tcp://HOST:8786), whose workers see the same files: use them.",
)
@click.option("--overwrite", is_flag=True, help="Make what is there already and up to date, too.")
@click.option("--quiet", is_flag=True, help="Tell of failures alone.")
@click.option(
    "--trace",
    type=click.Path(path_type=Path),
    metavar="FILE.json",
    help="Write what was done when, for Perfetto or chrome://tracing.",
)
def run(
    inputs: tuple[str, ...],
    output: Path,
    frames: int | None,
    truths: tuple[str, ...],
    transfer: str | None,
    layer: str | None,
    max_pixels: int,
    keep: tuple[str, ...],
    formats: tuple[str, ...],
    selectors: tuple[str, ...],
    memory: str | None,
    threads: int | None,
    shard: Shard,
    replay: Path | None,
    per_tar: int | None,
    dask: str | None,
    overwrite: bool,
    quiet: bool,
    trace: Path | None,
    **request: Any,
) -> None:
    """Run images through the chain: files, folders, globs or manifests (.csv, .jsonl) of linear
    float images (EXR), and of camera raws, which are developed as they are: they enter at
    normalize, where noise is past.

    Each makes OUT/NAME.jpg and OUT/NAME.json, the sidecar with everything that was used. A second
    run makes only what is missing or has changed. OUT/run.jsonl is the log. With
    --frames: OUT/NAME.frame0.jpg and so on, and OUT/NAME.truth.jpg, the same without noise.
    With --webdataset these are in tars, and dots in NAME become "_": a key of WebDataset has none.

    --truth development is that, without a burst. --truth mosaic is OUT/NAME.truth_mosaic.exr, the
    truth of --keep normalize. --truth variance is OUT/NAME.truth_variance.exr: for each pixel of
    that mosaic the variance of the noise that the chain adds, in signal squared, with what is fixed
    to a sensor (PRNU, DSNU, columns) and rounding, without clipping and defect pixels.
    """
    if replay:
        refuse_beside_replay()
        again = replay_of(replay, [Path(path) for path in inputs], max_pixels)
        if again.doubt:
            click.echo(f"clpipe: {replay}: warning: {again.doubt}", err=True)
        entrance, jobs, tars = again.entrance, [again.job], []
        chain = entrance.first_chain(jobs)
        target = OutputWriter(output, again.formats, again.burst, again.keep)
    else:
        entrance = ImageLoader(
            request_from_options(**request), ReadOptions(layer, max_pixels, transfer)
        )
        jobs = find_jobs(inputs, output, entrance.endings())
        tars = shard.take(cut(jobs, per_tar, output)) if per_tar else []
        jobs = [job for tar in tars for job in tar.jobs] if per_tar else shard.take(jobs)
        if not jobs:
            click.echo(f"shard {shard.number} of {shard.of} has no images", err=True)
            return
        entrance.check(jobs)
        chain = entrance.first_chain(jobs)
        for option, value in (("--layer", layer), ("--transfer", transfer)):
            if value is not None and chain.source is not Kind.RGB:
                raise RequestError(
                    f"{option}: it is one of a render, but the chain reads {chain.source.label}"
                )
        whole = entrance.asked.until is None or chain.result is Kind.DISPLAY
        formats = tuple(dict.fromkeys(formats)) or (("jpg",) if whole else ("exr",))
        target = OutputWriter(output, formats, RenditionPlan(frames, truths), chain.kept(keep))
    target.check(chain, jobs)
    if trace:
        check_trace(trace)
    budget = parse_size(memory) if memory else None
    engine = engine_for(
        RunSpec(entrance, target, selectors, budget, threads, overwrite, trace is not None),
        chain,
        tars,
        dask,
    )
    summary = Summary(len(jobs))
    with engine as batch, output_folder(output, shard):
        remove_unfinished(output, jobs)
        events = Trace() if trace else None
        start = {"arguments": sys.argv[1:], "images": len(jobs)}
        with (
            closing(batch.run(jobs)) as outcomes,
            closing(RunLog(output / log_name(shard), start)) as log,
            interruptible(batch.stop),
        ):
            reporter = Reporter(summary, target, Console(stderr=True), quiet)
            try:
                for outcome in outcomes:
                    summary.add(outcome)
                    log.add(outcome)
                    reporter.tell(outcome)
                    if events:
                        events.add(outcome)
            finally:
                summary.interrupted = summary.finished < summary.total
                log.end(summary)
                reporter.end()
    if events and trace:
        events.write(trace)
    if summary.interrupted:
        sys.exit(130)
    sys.exit(1 if summary.failures else 0)


def engine_for(
    spec: RunSpec, chain: Chain, tars: Sequence[Tar], dask: str | None
) -> AbstractContextManager[Batch | TarBatch | Cluster]:
    """What puts the images through: this machine, with or without tars, or a cluster.

    Raises:
        RequestError: both are asked for.
    """
    if dask is not None:
        if tars:
            raise RequestError("--dask: it makes no tars; use --webdataset with --shard")
        return connected(dask, spec)
    devices: list[Device | None] = [*open_devices(spec.selectors, spec.memory)]
    how = (spec.threads, spec.overwrite, spec.trace)
    if tars:
        return nullcontext(
            TarBatch(tars, spec.entrance, spec.target, devices or [None], chain, *how)
        )
    return nullcontext(Batch(spec.entrance, spec.target, devices or [None], chain, *how))


def folder_named(text: str) -> Path:
    """The folder for what comes out.

    Raises:
        RequestError: the name is empty.
    """
    if not text:
        raise RequestError("--output: it is empty; name a folder")
    return Path(text)


BESIDE_REPLAY = (
    *("inputs", "output", "replay", "max_pixels", "selectors", "memory"),
    *("overwrite", "quiet", "trace"),
)


def refuse_beside_replay() -> None:
    """See that nothing is asked for that a sidecar says.

    Raises:
        RequestError: something is.
    """
    context = click.get_current_context()
    for parameter in context.command.params:
        name = str(parameter.name)
        given = context.get_parameter_source(name) is not ParameterSource.DEFAULT
        if given and name not in BESIDE_REPLAY:
            raise RequestError(f"{parameter.opts[0]}: the sidecar says it; --replay repeats that")
