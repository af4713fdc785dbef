"""The command line. Thin: it turns options into settings and results into text."""

import json
import sys
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, NoReturn

import click
from rich.console import Console
from rich.table import Table

import clpipe
from clpipe import describe
from clpipe.batch import FORMATS, Target, find_jobs, prepare_folder, run_jobs
from clpipe.bench import bench as run_bench
from clpipe.check import SIZES, check_all
from clpipe.config import (
    Chain,
    Settings,
    make_chain,
    method_of,
    parse_assignment,
    read_settings,
    settings_from,
)
from clpipe.device import Device, choose, find_devices
from clpipe.errors import ClpipeError, RequestError
from clpipe.image_io import MAX_PIXELS
from clpipe.plan import make_plan
from clpipe.run import Runner
from clpipe.suggest import one_of

NUMPY = "numpy"
DEFAULTS = Settings()


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


def chain_options(function: Callable[..., Any]) -> Callable[..., Any]:
    """The options that say what chain to run."""
    options = [
        click.option(
            "-c", "--config", type=click.Path(path_type=Path), help="A TOML file with settings."
        ),
        click.option(
            "--camera",
            metavar="NAME|FILE",
            help=f"A built-in camera or a profile (.toml). [default: {DEFAULTS.camera}]",
        ),
        click.option(
            "--iso",
            type=float,
            help=f"The ISO; it sets noise and denoising. [default: {DEFAULTS.iso:g}]",
        ),
        click.option("--seed", type=int, help=f"The seed of the noise. [default: {DEFAULTS.seed}]"),
        click.option(
            "--set",
            "assignments",
            multiple=True,
            metavar="STAGE.PARAM=VALUE",
            help="Set a parameter; may be repeated. STAGE.method=NAME chooses a method.",
        ),
        click.option(
            "--stages",
            metavar="A,B,C",
            help="The stages to run, in order, instead of the default chain.",
        ),
        click.option(
            "--skip", multiple=True, metavar="STAGE", help="Leave a stage out; may be repeated."
        ),
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
    type=click.Choice(FORMATS),
    help="Of the last image; may be repeated. [default: jpg]",
)
json_option = click.option("--json", "as_json", is_flag=True, help="Print JSON.")


def chain_from(
    config: Path | None,
    camera: str | None,
    iso: float | None,
    seed: int | None,
    assignments: Sequence[str],
    stages: str | None,
    skip: Sequence[str],
) -> Chain:
    """The chain that a configuration file and the options over it ask for."""
    settings = read_settings(config) if config else DEFAULTS
    assigned: dict[str, dict[str, Any]] = {}
    for text in assignments:
        stage, parameter, value = parse_assignment(text)
        assigned.setdefault(stage, {})[parameter] = value
    tables = {stage: dict(table) for stage, table in settings.parameters.items()}
    for stage, values in assigned.items():
        table = tables.setdefault(stage, {})
        if "method" in values and values["method"] != method_of(stage, table):
            table.clear()  # what the file set belongs to another method
        table.update(values)
    plain: dict[str, Any] = {"camera": camera, "iso": iso, "seed": seed}
    if stages is not None:
        plain["stages"] = [name.strip() for name in stages.split(",") if name.strip()]
    if skip:
        plain["skip"] = [*settings.skip, *skip]
    given = settings_from({k: v for k, v in plain.items() if v is not None} | tables)
    named = {k: getattr(given, k) for k, v in plain.items() if v is not None}
    chain = make_chain(replace(settings, parameters=given.parameters, **named))
    for stage in assigned:
        chain.step_named(stage)
    return chain


def kept_names(chain: Chain, keep: Sequence[str]) -> tuple[str, ...]:
    """The steps to keep; ``all`` is every one."""
    if "all" in keep:
        return tuple(step.name for step in chain.steps)
    return tuple(chain.step_named(name).name for name in dict.fromkeys(keep))


def open_device(selector: str | None) -> Device | None:
    """The device that a selector names; None is NumPy."""
    if selector is not None and selector.lower() == NUMPY:
        return None
    return Device(choose(selector, find_devices()))


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
@click.argument("inputs", nargs=-1, required=True, metavar="INPUT...")
@click.option(
    "-o",
    "--output",
    required=True,
    type=click.Path(path_type=Path),
    metavar="OUT",
    help="The folder for what comes out; made if need be.",
)
@chain_options
@keep_option
@format_option
@device_option
def run(
    inputs: tuple[str, ...],
    output: Path,
    keep: tuple[str, ...],
    formats: tuple[str, ...],
    selector: str | None,
    **request: Any,
) -> None:
    """Run images through the chain: files, folders or globs of linear float images (EXR).

    Each makes OUT/NAME.jpg and OUT/NAME.json, the sidecar with everything that was used.
    """
    chain = chain_from(**request)
    kept = kept_names(chain, keep)
    formats = tuple(dict.fromkeys(formats)) or ("jpg",)
    jobs = find_jobs(inputs, output)
    target = Target(output, formats)
    target.check(chain, jobs, kept)
    device = open_device(selector)
    prepare_folder(output)
    eight_bit = any(f != "exr" for f in formats)
    runner = Runner(chain, device, kept, encode=eight_bit, final="exr" in formats)
    failed = 0
    for outcome in run_jobs(jobs, runner, target):
        if outcome.error:
            failed += 1
            click.echo(f"clpipe: {outcome.error}", err=True)
            continue
        for warning in outcome.warnings:
            click.echo(f"clpipe: {outcome.job.path}: warning: {warning}", err=True)
        made = target.path(outcome.job, formats[0])
        click.echo(
            f"{outcome.job.path} -> {made}  {outcome.megapixels:.1f} MP  {outcome.seconds:.2f} s",
            err=True,
        )
    if len(jobs) > 1 or failed:
        click.echo(f"{len(jobs) - failed} of {len(jobs)} images done, {failed} failed", err=True)
    sys.exit(1 if failed else 0)


@main.command()
@chain_options
@keep_option
@format_option
@json_option
def plan(keep: tuple[str, ...], formats: tuple[str, ...], as_json: bool, **request: Any) -> None:
    """Show the launches and buffer slots of a chain, without running it."""
    chain = chain_from(**request)
    eight_bit = not formats or any(f != "exr" for f in formats)
    made = make_plan(chain, keep=kept_names(chain, keep), encode=eight_bit, final="exr" in formats)
    if as_json:
        click.echo(json.dumps(describe.plan_record(made), indent=2))
        return
    table = Table(
        "launch", "opened by", "stages", "reads", "writes", "bytes/px", box=None, pad_edge=False
    )
    for row in describe.plan_rows(made):
        table.add_row(*row)
    console().print(table)
    click.echo(
        f"\n{len(made.launches)} launches, {made.slot_count} slots, "
        f"{made.bytes_per_pixel(8):.1f} bytes a pixel on the device"
    )


@main.command()
@click.argument("name", required=False)
@json_option
def stages(name: str | None, as_json: bool) -> None:
    """List the stages, or explain one: its methods and parameters."""
    from clpipe.registry import all_stages

    if name is not None and name not in all_stages():
        raise RequestError(one_of("stage", name, all_stages()))
    if as_json:
        chosen = [all_stages()[name]] if name else list(all_stages().values())
        click.echo(json.dumps([describe.stage_record(s) for s in chosen], indent=2))
        return
    out = console()
    if name is None:
        table = Table(
            "stage",
            "reads",
            "writes",
            "what it does",
            "methods (first is default)",
            box=None,
            pad_edge=False,
        )
        for stage in all_stages().values():
            table.add_row(
                stage.name,
                stage.reads.label,
                stage.writes.label,
                stage.summary,
                ", ".join(stage.by_name),
            )
        out.print(table)
        return
    stage = all_stages()[name]
    click.echo(
        f"{stage.name}: {stage.summary} Reads {stage.reads.label}, writes {stage.writes.label}."
    )
    for method in stage.methods:
        click.echo(f"\nmethod {method.method}: {method.summary}")
        rows = describe.parameter_rows(method)
        if rows:
            table = Table(
                "parameter", "default", "unit", "allowed", "what it is", box=None, pad_edge=False
            )
            for row in rows:
                table.add_row(*row)
            out.print(table)


@main.command()
@json_option
def devices(as_json: bool) -> None:
    """List the OpenCL devices, which one is used, and why others are passed over."""
    rows = describe.device_rows(find_devices())
    if as_json:
        click.echo(json.dumps(rows, indent=2))
        return
    table = Table(*(key.replace("_", " ") for key in rows[0]), box=None, pad_edge=False)
    for row in rows:
        table.add_row(*map(str, row.values()))
    console().print(table)


@main.command()
@device_option
@click.option("--small", is_flag=True, help="Only tiny images, for slow devices.")
@json_option
def check(selector: str | None, small: bool, as_json: bool) -> None:
    """Compare every kernel with its NumPy reference on a device, and the raw bit for bit."""
    device = open_device(selector)
    if device is None:
        raise RequestError("check: numpy is the reference; choose a device to compare with it")
    checks = []
    table = Table(
        "stage",
        "method",
        "cases",
        "samples",
        "differing",
        "largest",
        "allowed",
        "",
        box=None,
        pad_edge=False,
    )
    for result in check_all(device, SIZES[:5] if small else SIZES):
        checks.append(result)
        table.add_row(
            result.stage,
            result.method,
            str(result.cases),
            str(result.samples),
            str(result.differing),
            f"{result.largest:.2g}",
            f"{result.tolerance:.2g}",
            "ok" if result.passed else "FAILED",
        )
    failed = sum(not c.passed for c in checks)
    if as_json:
        click.echo(
            json.dumps(
                {
                    "device": device.info.label,
                    "failed": failed,
                    "checks": [c.record() for c in checks],
                },
                indent=2,
            )
        )
    else:
        click.echo(f"{device.info.label}, driver {device.info.driver}, {device.info.lanes} lanes")
        console().print(table)
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
@json_option
def bench(selector: str | None, size: str, repeat: int, as_json: bool, **request: Any) -> None:
    """Time the chain and each launch, from half RGB to eight-bit RGB on the device."""
    width, _, height = size.partition("x")
    numbers = width.isdecimal() and height.isdecimal()
    if not numbers or not 0 < int(width) * int(height) <= MAX_PIXELS:
        raise RequestError(
            f"--size: found {size!r}; expected WIDTHxHEIGHT, such as 6000x4000, "
            f"at most {MAX_PIXELS} pixels"
        )
    chain = chain_from(**request)
    device = open_device(selector)
    if device is None:
        raise RequestError("bench: it times the kernels of a device; numpy has none")
    report = run_bench(device, chain, int(width), int(height), repeat)
    if as_json:
        click.echo(json.dumps(report.record(), indent=2))
        return
    table = Table(box=None, pad_edge=False)
    table.add_column("launch")
    for heading in ("ms", "MP/s", "GB/s", "of copy"):
        table.add_column(heading, justify="right")
    for speed in (*report.launches, report.chain):
        table.add_row(
            speed.name,
            f"{speed.ms:.1f}",
            f"{speed.mp_per_s:.0f}",
            f"{speed.gb_per_s:.1f}",
            f"{speed.share_of_copy:.0%}",
        )
    click.echo(
        f"{report.device}: {report.width}x{report.height}, copy {report.copy_gb_per_s:.1f} GB/s, "
        f"{report.bytes_per_pixel:.1f} bytes a pixel, first run {report.first_run_s:.2f} s"
    )
    console().print(table)
