"""``clpipe devices``: list the OpenCL devices of this machine, and which one is used."""

from collections.abc import Sequence
from dataclasses import asdict
from typing import Any

import click

from clpipe.base.errors import DeviceError
from clpipe.base.memory import format_bytes
from clpipe.commands.options import Command, json_option
from clpipe.commands.printing import show, show_json
from clpipe.engine.discovery import DeviceInfo, choose, find_devices
from clpipe.engine.programs import CacheState, cache_state
from clpipe.engine.vendors import unloadable_drivers

FIELDS = ("index", "name", "platform", "driver", "type", "compute_units", "memory", "lanes")


@click.command("devices", cls=Command)
@json_option
def devices(as_json: bool) -> None:
    """List the OpenCL devices and the cache of compiled kernels.

    The list shows which device is used by default, and why the others are not.
    """
    found = find_devices(retest=True)
    rows, cache = device_rows(found), cache_state(found)
    broken = unloadable_drivers()
    if as_json:
        show_json({"devices": rows, "unloadable_drivers": broken, "kernel_cache": asdict(cache)})
        return
    shown = [{key: v for key, v in row.items() if key != "target_reason"} for row in rows]
    show([key.replace("_", " ") for key in shown[0]], [[*map(str, r.values())] for r in shown])
    for row in rows:
        if row["target"]:
            lanes = f"{row['lanes']} lanes"
            click.echo(f"{row['index']}: for {row['target']}, {lanes}: {row['target_reason']}")
    for path, reason in broken.items():
        click.echo(f"{path}: {reason}")
    click.echo(cache_text(cache))


def cache_text(cache: CacheState) -> str:
    """Return the kernel cache's state in words."""
    if cache.folder is None:
        return f"no kernel cache: {cache.problem}"
    size = f"{format_bytes(cache.bytes)}, {cache.programs} compiled programs"
    text = f"kernel cache: {cache.folder}, {size}, {cache.usable} of them for this environment"
    return f"{text}; read-only: {cache.problem}" if cache.problem else text


def device_rows(devices: Sequence[DeviceInfo]) -> list[dict[str, Any]]:
    """Return a row for each device, with its status: used, or why not. NumPy is the last row."""
    try:
        used: DeviceInfo | None = choose(None, list(devices))
    except DeviceError:
        used = None
    rows: list[dict[str, Any]] = []
    for device in devices:
        if device is used:
            status = "used by default"
        elif device.problem:
            status = f"not used: {device.problem}"
        elif device.type == "emulator":
            status = f"not used: an emulator is slow; use it with --device {device.index}"
        elif used and used.type == "GPU" and device.type != "GPU":
            status = f"not used: there is a GPU; use it with --device {device.index}"
        else:
            status = f"not used: another device is first; use it with --device {device.index}"
        values = {name: getattr(device, name) for name in FIELDS}
        target = {"target": device.target.name, "target_reason": device.target.reason}
        memory = {"memory": f"{device.memory / 2**30:.1f} GiB"}
        rows.append({**values, **memory, **target, "status": status})
    blank = dict.fromkeys((*FIELDS, "target", "target_reason"), "")
    numpy = {"index": "numpy", "name": "NumPy", "platform": "the references", "type": "CPU"}
    return [*rows, {**blank, **numpy, "status": "slow; use it with --device numpy"}]
