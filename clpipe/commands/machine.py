"""Describes the machine of a measurement, without the user's paths."""

import platform
from typing import Any

import click

from clpipe.base.about import full_version
from clpipe.engine.device import Device
from clpipe.outputs.program import all_versions, device_record


def machine_record(device: Device) -> dict[str, Any]:
    """Return a device and the versions of the software that it runs, as JSON values."""
    info = device.info
    return {
        "clpipe": full_version(),
        "device": device_record(device)
        | {"type": info.type, "compute_units": info.compute_units, "memory": info.memory},
        "versions": all_versions() | {"system": platform.platform()},
    }


def ask_for_report(device: Device) -> None:
    """Print how to report results from a device that is not a CPU, because few are tested."""
    if device.info.type != "CPU":
        click.echo(
            f"clpipe is developed on CPUs. To report results for this {device.info.type}, run "
            "the same command with --json and send the output to the developers. The output "
            "contains the device, its driver, versions and these results, but none of your "
            "paths."
        )
