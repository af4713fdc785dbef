"""``clpipe check``: compare kernels with their NumPy references."""

import sys
from pathlib import Path

import click

from clpipe.base.errors import RequestError
from clpipe.chain.keys import CODE
from clpipe.chain.methods import stage_named
from clpipe.chain.registry import load_stage_file
from clpipe.commands.chain_options import device_option, options
from clpipe.commands.completion import steps
from clpipe.commands.machine import ask_for_report, machine_record
from clpipe.commands.options import Command, json_option
from clpipe.commands.printing import show, show_json
from clpipe.engine.check import SIZES, Check, check_all
from clpipe.engine.device import open_device


@click.command("check", cls=Command)
@click.argument("names", nargs=-1, metavar="[STAGE]...", shell_complete=steps)
@device_option
@click.option("--small", is_flag=True, help="Compare tiny images only, for slow devices.")
@options(CODE)
@json_option
def check(
    names: tuple[str, ...],
    selector: str | None,
    small: bool,
    stage_files: tuple[Path, ...],
    as_json: bool,
) -> None:
    """Compare kernels with their NumPy references on a device.

    Without STAGE, all stages are compared. The raw is then compared bit for bit, and images that
    share launches are compared with the same images processed one by one.
    """
    for file in stage_files:
        load_stage_file(file)
    chosen = [stage_named("check", name) for name in names]
    device = open_device(selector)
    if device is None:
        raise RequestError(
            "--device: found numpy, which is the reference; choose a device from 'clpipe devices'"
        )
    checks = list(check_all(device, chosen, SIZES[:5] if small else SIZES))
    failed = sum(not c.passed for c in checks)
    if as_json:
        records = [c.record() for c in checks]
        show_json({**machine_record(device), "failed": failed, "checks": records})
    else:
        target = f" for {device.info.target.name}" if device.info.target.name else ""
        lanes = f"{device.info.lanes} lanes{target}"
        click.echo(f"{device.info.label}, driver {device.info.driver}, {lanes}")
        headings = ("stage", "method", "cases", "samples", "differing", "largest", "allowed", "")
        show(headings, map(check_row, checks))
        click.echo(f"{len(checks) - failed} passed, {failed} failed")
        ask_for_report(device)
    sys.exit(1 if failed else 0)


def check_row(check: Check) -> tuple[str, ...]:
    """Return the row of one comparison of a kernel with its reference."""
    return (
        check.stage,
        check.method,
        str(check.cases),
        str(check.difference.samples),
        str(check.difference.differing),
        f"{check.difference.largest:.2g}",
        f"{check.tolerance:.2g}",
        "ok" if check.passed else "FAILED",
    )
