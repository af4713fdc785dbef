"""``clpipe devices``: the OpenCL devices of this machine, and which one is used."""

from collections.abc import Sequence
from typing import Any

import click

from clpipe.base.errors import DeviceError
from clpipe.commands.options import Command, json_option
from clpipe.commands.printing import show, show_json
from clpipe.engine.discovery import DeviceInfo, choose, find_devices


@click.command("devices", cls=Command)
@json_option
def devices(as_json: bool) -> None:
    """List the OpenCL devices, and say which one is used and why others are not."""
    rows = device_rows(find_devices(again=True))
    if as_json:
        show_json(rows)
        return
    shown = [{key: v for key, v in row.items() if key != "target_reason"} for row in rows]
    show([key.replace("_", " ") for key in shown[0]], [[*map(str, r.values())] for r in shown])
    for row in rows:
        if row["target"]:
            lanes = f"{row['lanes']} lanes"
            click.echo(f"{row['index']}: for {row['target']}, {lanes}: {row['target_reason']}")


def device_rows(devices: Sequence[DeviceInfo]) -> list[dict[str, Any]]:
    """A row for each device, with its status: used, or why it is passed over. NumPy is the last."""
    try:
        used: DeviceInfo | None = choose(None, list(devices))
    except DeviceError:
        used = None
    rows: list[dict[str, Any]] = []
    for device in devices:
        if device is used:
            status = "used by default"
        elif device.problem:
            status = f"passed over: {device.problem}"
        elif device.type == "emulator":
            status = f"passed over: an emulator, slow; --device {device.index}"
        elif used and used.type == "GPU" and device.type != "GPU":
            status = f"passed over: there is a GPU; --device {device.index}"
        else:
            status = f"passed over: another one comes first; --device {device.index}"
        rows.append(
            {
                "index": device.index,
                "name": device.name,
                "platform": device.platform,
                "driver": device.driver,
                "type": device.type,
                "compute_units": device.compute_units,
                "memory": f"{device.memory / 2**30:.1f} GiB",
                "lanes": device.lanes,
                "target": device.target.name,
                "target_reason": device.target.reason,
                "status": status,
            }
        )
    numpy = "slow; --device numpy"
    blank = dict.fromkeys(
        ("driver", "compute_units", "memory", "lanes", "target", "target_reason"), ""
    )
    rows.append(
        {"index": "numpy", "name": "NumPy", "platform": "the references", "type": "CPU"}
        | blank
        | {"status": numpy}
    )
    return rows
