"""The command line. Thin: it turns options into settings and results into text."""

import json
import os
import sys
from collections.abc import Callable, Iterable, Sequence
from contextlib import AbstractContextManager, closing, nullcontext
from dataclasses import asdict
from pathlib import Path
from typing import Any, NoReturn

import click
from click.core import ParameterSource
from rich.console import Console
from rich.table import Table

import clpipe
from clpipe import describe
from clpipe.asked import DEFAULTS, asked_for
from clpipe.batch import Batch
from clpipe.bench import bench as run_bench
from clpipe.bench import bench_methods
from clpipe.bench_batch import bench_batch, loads
from clpipe.calibration_frames import Given, calibrate_files, check_name, write_profile
from clpipe.camera import built_in_cameras, load_camera
from clpipe.check import SIZES, check_all
from clpipe.cluster import Cluster, Order, connected
from clpipe.config import Chain, Settings, built_in_configs, overlay, stage_named
from clpipe.device import Device, find_devices, open_device, open_devices
from clpipe.entrance import Entrance
from clpipe.errors import ClpipeError, RequestError
from clpipe.image_io import MAX_PIXELS, TRANSFERS, USUAL_MAX_PIXELS, Reading
from clpipe.interrupt import interruptible
from clpipe.jobs import Shard, find_jobs, parse_shard
from clpipe.measure import load
from clpipe.measure import measure as measure_images
from clpipe.memory import parse_size
from clpipe.output_folder import output_folder, remove_unfinished
from clpipe.progress import Reporter
from clpipe.raw_dump import TYPES
from clpipe.reference.cfa import PATTERNS, Pattern
from clpipe.registry import all_stages, load_stage_file
from clpipe.replay import replay_of
from clpipe.run_log import RunLog, Summary, log_name
from clpipe.shots import TRUTHS, Burst, Shot
from clpipe.stage import Kind, Stage
from clpipe.suggest import one_of
from clpipe.target import EVERY_FORMAT, Target
from clpipe.trace import Trace, check_trace
from clpipe.webdataset import Tar, TarBatch, cut


class Group(click.Group):
    """Commands that report a user's mistake as one message, with its exit status."""

    def invoke(self, ctx: click.Context) -> Any:
        try:
            return super().invoke(ctx)
        except ClpipeError as error:
            fail(error)
        except KeyboardInterrupt:
            click.echo("interrupted", err=True)
            sys.exit(130)
        except BrokenPipeError:
            sys.exit(0)
        except OSError as error:
            fail(RequestError(f"cannot print: {error.strerror}"))


def fail(error: ClpipeError) -> NoReturn:
    """Say what was wrong and leave with its exit status."""
    click.echo(f"clpipe: {error}", err=True)
    sys.exit(error.exit_status)


def console() -> Console:
    """Where tables go. A pipe gets room for whole lines."""
    return Console(width=None if sys.stdout.isatty() else 140, highlight=False)


def show(headings: Sequence[str], rows: Iterable[Sequence[str]], left: int | None = None) -> None:
    """Print a table whose first ``left`` columns stand left and the others right; None is all."""
    table = Table(box=None, pad_edge=False)
    for number, heading in enumerate(headings):
        table.add_column(heading, justify="left" if left is None or number < left else "right")
    for row in rows:
        table.add_row(*row)
    console().print(table)


def show_json(values: Any) -> None:
    """Print values as JSON."""
    click.echo(json.dumps(values, indent=2))


stage_file_option = click.option(
    "--stage-file",
    "stage_files",
    multiple=True,
    type=click.Path(path_type=Path),
    metavar="FILE.py",
    help="Load a stage of your own; may be repeated.",
)


camera_option = click.option(
    "--camera",
    metavar="NAME|FILE",
    help=f"A built-in camera or a profile (.toml). [default: {DEFAULTS.camera}]",
)
iso_option = click.option(
    "--iso",
    type=float,
    help=f"The ISO; it sets noise and denoising. [default: {DEFAULTS.iso:g}]",
)


def chain_options(function: Callable[..., Any]) -> Callable[..., Any]:
    """The options that say what chain to run."""
    options = [
        click.option(
            "-c",
            "--config",
            metavar="NAME|FILE",
            help=f"Settings: {' or '.join(built_in_configs())}, or a TOML file.",
        ),
        camera_option,
        iso_option,
        click.option("--seed", type=int, help=f"The seed of the noise. [default: {DEFAULTS.seed}]"),
        click.option(
            "--set",
            "assignments",
            multiple=True,
            metavar="STAGE.PARAM=VALUE",
            help="Set a parameter; may be repeated. STAGE.method=NAME chooses a method. "
            "'{uniform=[1, 2]}' draws a value for each image.",
        ),
        click.option(
            "--stages",
            metavar="A,B,C",
            help="The stages to run, in order, instead of the default chain.",
        ),
        click.option(
            "--skip", multiple=True, metavar="STAGE", help="Leave a stage out; may be repeated."
        ),
        click.option("--start-at", metavar="STAGE", help="Enter here, with kept images, mosaics."),
        click.option("--until", metavar="STAGE", help="Leave the chain after this stage."),
        stage_file_option,
    ]
    for option in reversed(options):
        function = option(function)
    return function


device_option = click.option(
    "--device",
    "selector",
    metavar="SEL",
    help="An index or a part of a name from 'clpipe devices', or numpy.",
)
keep_option = click.option(
    "--keep",
    multiple=True,
    metavar="STAGE|all",
    help="Write a stage's image too, as float EXR; may be repeated.",
)
format_option = click.option(
    "--format",
    "formats",
    multiple=True,
    type=click.Choice(EVERY_FORMAT),
    help="Of the last image (dng: of the raw, as quantize makes it); may be repeated. "
    "[default: jpg; exr where --until cuts it off]",
)
json_option = click.option("--json", "as_json", is_flag=True, help="Print JSON.")


@click.group(
    cls=Group, context_settings={"help_option_names": ["-h", "--help"], "max_content_width": 100}
)
@click.version_option(clpipe.__version__, prog_name="clpipe")
def main() -> None:
    """Put clean, linear renders through a camera: mosaic, sensor noise, development.

    \b
    clpipe run render.exr -o out --iso 3200
    clpipe stages sensor_noise
    """


@main.command()
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
        target = Target(output, again.formats, again.burst, again.keep)
    else:
        entrance = Entrance(asked_for(**request), Reading(layer, max_pixels, transfer))
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
        target = Target(output, formats, Burst(frames, truths), chain.kept(keep))
    target.check(chain, jobs)
    if trace:
        check_trace(trace)
    budget = parse_size(memory) if memory else None
    engine = engine_for(
        Order(entrance, target, selectors, budget, threads, overwrite, trace is not None),
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
    order: Order, chain: Chain, tars: Sequence[Tar], dask: str | None
) -> AbstractContextManager[Batch | TarBatch | Cluster]:
    """What puts the images through: this machine, with or without tars, or a cluster.

    Raises:
        RequestError: both are asked for.
    """
    if dask is not None:
        if tars:
            raise RequestError("--dask: it makes no tars; use --webdataset with --shard")
        return connected(dask, order)
    devices: list[Device | None] = [*open_devices(order.selectors, order.memory)]
    how = (order.threads, order.overwrite, order.trace)
    if tars:
        return nullcontext(
            TarBatch(tars, order.entrance, order.target, devices or [None], chain, *how)
        )
    return nullcontext(Batch(order.entrance, order.target, devices or [None], chain, *how))


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


@main.command()
@chain_options
@keep_option
@format_option
@json_option
@click.option("--toml", "as_toml", is_flag=True, help="Print the chain as a configuration.")
def plan(
    keep: tuple[str, ...], formats: tuple[str, ...], as_json: bool, as_toml: bool, **request: Any
) -> None:
    """Show the launches and buffer slots of a chain, without running it.

    A launch is one kernel call over the image. Stages that look at a pixel alone join the launch
    before them; a stencil, a reduction and a kept image open one. A slot is a buffer of one plane.
    """
    asked = asked_for(**request)
    if as_toml:
        if asked.start_at or asked.until or as_json:
            raise RequestError(
                "plan: --toml prints a whole chain, which neither --start-at nor --until is part "
                "of, and --json prints the plan"
            )
        click.echo(describe.toml_text(asked.chain()), nl=False)
        return
    chain = asked.chain()
    target = Target(Path(), formats or ("jpg",), keep=chain.kept(keep))
    made = target.runner(Shot("", chain, ""), None).plan()
    if as_json:
        show_json(describe.plan_record(made))
        return
    headings = ("launch", "opened by", "stages", "reads", "writes", "bytes/px")
    show(headings, describe.plan_rows(made))
    click.echo(
        f"\n{len(made.launches)} launches, {made.slot_count} slots, "
        f"{made.bytes_per_pixel(8):.1f} bytes a pixel on the device"
    )


@main.command()
@click.argument("name", required=False)
@camera_option
@iso_option
@stage_file_option
@json_option
def stages(
    name: str | None,
    camera: str | None,
    iso: float | None,
    stage_files: tuple[Path, ...],
    as_json: bool,
) -> None:
    """List the stages, or explain one: its methods and parameters, for a camera and an ISO."""
    for file in stage_files:
        load_stage_file(file)
    if name is not None and name not in all_stages():
        raise RequestError(one_of("stage", name, all_stages()))
    values = {"camera": camera, "iso": iso}
    settings = overlay(DEFAULTS, {k: v for k, v in values.items() if v is not None})
    chosen = [all_stages()[name]] if name else list(all_stages().values())
    if as_json:
        records = [describe.stage_record(s, describe.context_for(s, settings)) for s in chosen]
        show_json(records)
    elif name is None:
        headings = ("stage", "reads", "writes", "what it does", "methods (first is default)")
        show(headings, map(describe.stage_row, chosen))
    else:
        explain_stage(chosen[0], settings)


def explain_stage(stage: Stage, settings: Settings) -> None:
    """One stage: its methods and parameters, and what a camera and an ISO make of them."""
    context = describe.context_for(stage, settings)
    reads, writes = stage.reads.label, stage.writes.label
    click.echo(f"{stage.name}: {stage.summary} Reads {reads}, writes {writes}.")
    place = f"{context.camera.name}, ISO {context.iso:g}"
    for method in stage.methods:
        click.echo(f"\nmethod {method.method}: {method.summary}")
        rows = describe.parameter_rows(method)
        automatic = describe.resolved(method, context)
        headings = ["parameter", "default", *([place] if automatic else []), "unit", "allowed", ""]
        if automatic:
            rows = [(row[0], row[1], automatic.get(row[0], ""), *row[2:]) for row in rows]
        if rows:
            show(headings, rows)
    if stage.explain:
        click.echo(f"\n{stage.explain(context)}")


@main.command()
@click.argument("name", required=False, metavar="[NAME|FILE]")
@click.option("--iso", type=float, help="The ISO. [default: those that were measured]")
@json_option
def cameras(name: str | None, iso: float | None, as_json: bool) -> None:
    """List the cameras, or show one: its noise in all three ways, and its sources."""
    if name is None:
        if iso is not None:
            raise RequestError("--iso: name the camera that it is of")
        records = [describe.camera_record(load_camera(n)) for n in built_in_cameras()]
        if as_json:
            show_json(records)
            return
        every = map(load_camera, built_in_cameras())
        show(
            ("camera", "make and model", "ISO", "gain stages from"), map(describe.camera_row, every)
        )
        return
    camera = load_camera(name)
    if as_json:
        show_json(describe.camera_record(camera, iso))
        return
    for title, headings, rows in describe.camera_tables(camera, iso):
        click.echo(title)
        show(headings, rows, left=1)
        click.echo("")
    for key, source in camera.sources.items():
        click.echo(f"{key}: {source}")


@main.command()
@json_option
def devices(as_json: bool) -> None:
    """List the OpenCL devices, which one is used, and why others are passed over."""
    rows = describe.device_rows(find_devices())
    if as_json:
        show_json(rows)
        return
    show([key.replace("_", " ") for key in rows[0]], [[*map(str, r.values())] for r in rows])


@main.command()
@click.argument("names", nargs=-1, metavar="[STAGE]...")
@device_option
@click.option("--small", is_flag=True, help="Only tiny images, for slow devices.")
@stage_file_option
@json_option
def check(
    names: tuple[str, ...],
    selector: str | None,
    small: bool,
    stage_files: tuple[Path, ...],
    as_json: bool,
) -> None:
    """Compare kernels with their NumPy references on a device: of these stages, or of all, and then
    the raw bit for bit.
    """
    for file in stage_files:
        load_stage_file(file)
    chosen = [stage_named("check", name) for name in names]
    device = open_device(selector)
    if device is None:
        raise RequestError("check: numpy is the reference; choose a device to compare with it")
    checks = list(check_all(device, chosen, SIZES[:5] if small else SIZES))
    failed = sum(not c.passed for c in checks)
    if as_json:
        records = [c.record() for c in checks]
        show_json({"device": device.info.label, "failed": failed, "checks": records})
    else:
        click.echo(f"{device.info.label}, driver {device.info.driver}, {device.info.lanes} lanes")
        headings = ("stage", "method", "cases", "samples", "differing", "largest", "allowed", "")
        show(headings, map(describe.check_row, checks))
        click.echo(f"{len(checks) - failed} passed, {failed} failed")
    sys.exit(1 if failed else 0)


@main.command()
@chain_options
@device_option
@click.option(
    "--size", default="6000x4000", show_default=True, metavar="WxH", help="The picture's size."
)
@click.option(
    "--repeat", default=7, show_default=True, type=click.IntRange(1), help="Runs; the best counts."
)
@click.option(
    "--methods", metavar="STAGE", help="Time each method of this stage instead, on its own."
)
@click.option(
    "--batch",
    is_flag=True,
    help="Time whole batches of files instead, half EXR to JPEG, in threads and serially.",
)
@json_option
def bench(
    selector: str | None,
    size: str,
    repeat: int,
    methods: str | None,
    batch: bool,
    as_json: bool,
    **request: Any,
) -> None:
    """Time the chain and each launch, from half RGB to eight-bit RGB on the device."""
    width, _, height = size.partition("x")
    numbers = width.isdecimal() and height.isdecimal()
    if not numbers or not 0 < int(width) * int(height) <= MAX_PIXELS:
        raise RequestError(
            f"--size: found {size!r}; expected WIDTHxHEIGHT, such as 6000x4000, "
            f"at most {MAX_PIXELS} pixels"
        )
    asked = asked_for(**request)
    chain = asked.chain()
    device = open_device(selector)
    if device is None:
        raise RequestError("bench: it times the kernels of a device; numpy has none")
    if methods is not None:
        stage = stage_named("--methods", methods)
        speeds = bench_methods(device, stage, chain.settings, int(width), int(height), repeat)
        if as_json:
            show_json([asdict(speed) for speed in speeds])
            return
        click.echo(f"{device.info.label}: {stage.name}, {width}x{height}, planes to planes")
        rows = [(s.method, f"{s.launches}", f"{s.ms:.1f}", f"{s.mp_per_s:.0f}") for s in speeds]
        show(("method", "launches", "ms", "MP/s"), rows, left=1)
        return
    if batch:
        batches = [bench_batch(device, asked, load) for load in loads()]
        if as_json:
            show_json({"device": device.info.label, "batches": [b.record() for b in batches]})
            return
        click.echo(f"{device.info.label}: half EXR to JPEG, {len(os.sched_getaffinity(0))} CPUs")
        show(describe.BATCH_HEADINGS, map(describe.batch_row, batches), left=1)
        return
    report = run_bench(device, chain, int(width), int(height), repeat)
    if as_json:
        show_json(report.record())
        return
    click.echo(
        f"{report.device}: {report.width}x{report.height}, copy {report.copy_gb_per_s:.1f} GB/s, "
        f"{report.bytes_per_pixel:.1f} bytes a pixel, first run {report.first_run_s:.2f} s"
    )
    show(
        ("launch", "ms", "MP/s", "GB/s", "of copy"),
        (
            (
                speed.name,
                f"{speed.ms:.1f}",
                f"{speed.mp_per_s:.0f}",
                f"{speed.gb_per_s:.1f}",
                f"{speed.share_of_copy:.0%}",
            )
            for speed in (*report.launches, report.chain)
        ),
        left=1,
    )


@main.command()
@click.argument("inputs", nargs=-1, required=True, metavar="FRAMES...")
@click.option(
    "-o",
    "--output",
    required=True,
    type=click.Path(path_type=Path),
    metavar="CAMERA.toml",
    help="The profile; CAMERA.png, a picture of the fit, is written beside it.",
)
@click.option(
    "--dark",
    multiple=True,
    metavar="FILES",
    help="Frames without light, or a quoted glob; may be repeated.",
)
@click.option("--black-level", type=float, metavar="DN", help="Instead of what the files say.")
@click.option("--white-level", type=float, metavar="DN", help="Instead of what the files say.")
@click.option("--pattern", type=click.Choice(PATTERNS), help="Instead of what the files say.")
@click.option(
    "--iso",
    type=click.FloatRange(0, min_open=True),
    help="Of all frames, instead of what the files say.",
)
@json_option
def calibrate(
    inputs: tuple[str, ...],
    output: Path,
    dark: tuple[str, ...],
    black_level: float | None,
    white_level: float | None,
    pattern: Pattern | None,
    iso: float | None,
    as_json: bool,
) -> None:
    """Measure a sensor's noise from raw frames, and write it as a camera profile.

    FRAMES are camera raws, mosaics that clpipe kept, or mosaics from elsewhere (EXR, 16-bit TIFF or
    PNG, with the options for what they do not say): two or more of one static scene that has dark
    and bright places, at each ISO. Dark frames (lens cap on) give column noise, DSNU, hot pixels
    and a better b. A single frame at an ISO is judged alone, which is less exact.

    \b
    clpipe calibrate scene/*.CR2 --dark 'dark/*.CR2' -o my_camera.toml
    clpipe run render.exr -o out --camera my_camera.toml --iso 800
    """
    check_name(output)
    given = Given(black_level, white_level, pattern, iso)
    frames, found = calibrate_files(inputs, dark, given)
    picture = write_profile(output, frames, found)
    if as_json:
        record = {
            "profile": str(output),
            "picture": str(picture),
            "make": frames.make,
            "model": frames.model,
            "isos": [c.record() for c in found],
        }
        show_json(record)
        return
    show(describe.CALIBRATION, map(describe.calibration_row, found), left=0)
    for one in found:
        for note in one.notes:
            click.echo(f"ISO {one.iso:g}: {note}")
    click.echo(f"\nwrote {output} and {picture}")


@main.command()
@click.argument(
    "images", nargs=-1, required=True, type=click.Path(path_type=Path), metavar="IMAGE..."
)
@click.option(
    "--truth", type=click.Path(path_type=Path), metavar="FILE", help="The same image without noise."
)
@click.option(
    "--pattern",
    default="RGGB",
    show_default=True,
    type=click.Choice(PATTERNS),
    help="Of mosaics that do not say their own.",
)
@click.option(
    "--plot",
    type=click.Path(path_type=Path),
    metavar="FILE.png",
    help="Draw noise by intensity, autocorrelation and tails.",
)
@json_option
def measure(
    images: tuple[Path, ...], truth: Path | None, pattern: Pattern, plot: Path | None, as_json: bool
) -> None:
    """Measure the noise of images: how large, how correlated, how Gaussian.

    IMAGE is a kept EXR of any stage, a mosaic, or a finished picture (JPEG, PNG, TIFF). Noise is
    the difference from --truth, or, of two or more frames of one scene, from their mean.

    \b
    clpipe run render.exr -o noisy --iso 3200 --until quantize
    clpipe run render.exr -o clean --iso 3200 --until quantize \\
        --skip sensor_noise --skip row_noise --skip column_noise
    clpipe measure noisy/render.exr --truth clean/render.exr
    """
    if plot is not None and plot.suffix != ".png":
        raise RequestError(f"--plot: found {plot}; expected a name that ends in .png")
    report = measure_images(
        [load(path, pattern) for path in images], load(truth, pattern) if truth else None
    )
    if plot is not None:
        from clpipe.measure_plot import draw

        draw(report, plot)
    if as_json:
        show_json(report.record())
        return
    click.echo(describe.measure_heading(report))
    for title, (headings, *rows) in describe.measure_tables(report):
        click.echo(f"\n{title}")
        show(headings, rows, left=0 if headings[0] else 1)
