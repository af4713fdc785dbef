"""What was measured on: the machine, in a form that tells its owner's paths to nobody."""

import platform
from typing import Any

import click

from clpipe.base.about import full_version
from clpipe.engine.device import Device
from clpipe.outputs.program import all_versions, device_record


def machine_record(device: Device) -> dict[str, Any]:
    """A device and the versions of all that runs on it, as JSON values."""
    info = device.info
    return {
        "clpipe": full_version(),
        "device": device_record(device)
        | {"type": info.type, "compute_units": info.compute_units, "memory": info.memory},
        "versions": all_versions() | {"system": platform.platform()},
    }


def ask_for_report(device: Device) -> None:
    """Say what to report from a device that is no CPU, since only CPUs are at hand here."""
    if device.info.type != "CPU":
        click.echo(
            f"clpipe is developed on CPUs. To report how it does on this {device.info.type}, send "
            "its developers what the same command prints with --json: the device, its driver, "
            "versions and these results, and none of your paths."
        )
