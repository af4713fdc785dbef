"""``clpipe bench``: time a chain, a stage's methods or whole batches on a device."""

from dataclasses import asdict, replace
from typing import Any

import click

from clpipe.base.errors import RequestError
from clpipe.base.processors import available_processors
from clpipe.base.text import whole_number
from clpipe.batch.bench import CPU_STEPS, BatchSpeed, bench_batch, workloads
from clpipe.chain.methods import base_name, stage_named
from clpipe.commands.chain_options import chain_options, device_option, request_of
from clpipe.commands.completion import methods_of
from clpipe.commands.machine import ask_for_report, machine_record
from clpipe.commands.options import Command, json_option
from clpipe.commands.printing import Rows, show, show_json
from clpipe.engine.bench import Speed, bench_methods
from clpipe.engine.bench import bench as run_bench
from clpipe.engine.device import open_device
from clpipe.images.pixels import MAX_PIXELS

BATCH_HEADINGS = ("images", "MP/s", "s", *CPU_STEPS, "ms CPU", "busy", "peak MiB")


@click.command("bench", cls=Command)
@chain_options
@device_option
@click.option(
    "--size", default="6000x4000", show_default=True, metavar="WxH", help="The image size in px."
)
@click.option(
    "--repeat",
    default=7,
    show_default=True,
    type=click.IntRange(1),
    help="The number of runs. The fastest one is reported.",
)
@click.option(
    "--methods",
    metavar="STAGE",
    shell_complete=methods_of,
    help="Time each method of this stage separately, instead of the chain.",
)
@click.option(
    "--batch",
    is_flag=True,
    help="Time batches of files instead, from half-float EXR to JPEG, with the CPU time of each "
    "step.",
)
@json_option
def bench(
    selector: str | None,
    size: str,
    repeat: int,
    methods: str | None,
    batch: bool,
    as_json: bool,
    **options: Any,
) -> None:
    """Time a chain and each of its launches on a device.

    The image is of the kind that the chain reads: a render, or with --start-at a mosaic or a raw.
    The input is in half floats (a raw in floats) and the output has 8 bits. Both stay on the
    device.
    """
    width, height = map(whole_number, size.partition("x")[::2])
    if min(width, height) < 1 or width * height > MAX_PIXELS:
        raise RequestError(
            f"--size: found {size!r}; expected WIDTHxHEIGHT, such as 6000x4000, "
            f"at most {MAX_PIXELS} pixels"
        )
    request = request_of(options)
    settings = request.settings()
    if request.start_at is None and (names := settings.step_names):
        reads = stage_named("--stages", base_name(names[0])).reads
        # If the chain begins with a mosaic, renders cannot be its input.
        if len(reads.channels) == 1:
            request = replace(request, start_at=names[0])
    chain = request.chain()
    device = open_device(selector)
    if device is None:
        raise RequestError(
            "--device: found numpy, which has no kernels to time; choose a device from "
            "'clpipe devices'"
        )
    if methods is not None:
        stage = stage_named("--methods", methods)
        speeds = bench_methods(device, stage, chain.settings, width, height, repeat)
        record = {**machine_record(device), "methods": [asdict(speed) for speed in speeds]}
        title = f"{device.info.label}: {stage.name}, {width}x{height}, planes to planes"
        headings: tuple[str, ...] = ("method", "launches", "ms", "MP/s")
        rows: Rows = [
            (s.method, f"{s.launches}", f"{s.ms:.1f}", f"{s.mp_per_s:.0f}") for s in speeds
        ]
    elif batch:
        batches = [bench_batch(device, request, workload) for workload in workloads()]
        record = {**machine_record(device), "batches": [b.record() for b in batches]}
        title = (
            f"{device.info.label}: half-float EXR to JPEG on {available_processors()} CPUs. "
            "For each image, the table lists the CPU time of each step in ms, their sum, and "
            "its share of the CPUs' time."
        )
        headings, rows = BATCH_HEADINGS, list(map(batch_row, batches))
    else:
        report = run_bench(device, chain, width, height, repeat)
        record = report.record() | machine_record(device)
        title = (
            f"{report.device}: {report.width}x{report.height}, "
            f"copy {report.copy_gb_per_s:.1f} GB/s, {report.bytes_per_pixel:.1f} bytes a pixel, "
            f"first run {report.first_run_s:.2f} s"
        )
        headings = ("launch", "ms", "MP/s", "GB/s", "of copy")
        rows = [launch_row(speed) for speed in (*report.launches, report.chain)]
    if as_json:
        show_json(record)
        return
    click.echo(title)
    show(headings, rows, left=1)
    ask_for_report(device)


def launch_row(speed: Speed) -> tuple[str, ...]:
    """Return the table row of one launch, or of the chain."""
    numbers = f"{speed.ms:.1f}", f"{speed.mp_per_s:.0f}", f"{speed.gb_per_s:.1f}"
    return speed.name, *numbers, f"{speed.share_of_copy:.0%}"


def batch_row(speed: BatchSpeed) -> tuple[str, ...]:
    """Return the table row of one batch."""
    return (
        f"{speed.images} of {speed.width}x{speed.height}",
        f"{speed.megapixels_per_second:.1f}",
        f"{speed.seconds:.1f}",
        *(f"{ms:.1f}" for ms in speed.cpu_ms.values()),
        f"{sum(speed.cpu_ms.values()):.1f}",
        f"{speed.busy:.0%}",
        "" if speed.peak_mib is None else f"{speed.peak_mib:.0f}",
    )
