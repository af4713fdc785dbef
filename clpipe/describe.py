"""Plans, stages and devices in words, for people and for programs."""

import json
import types
from collections.abc import Sequence
from typing import Annotated, Any, Literal, Union, get_args, get_origin

from clpipe.device import Found, choose
from clpipe.errors import DeviceError
from clpipe.plan import AnyLaunch, Launch, Lines, Plan, launch_bytes
from clpipe.stage import Method, Stage

LIMITS = {"ge": ">=", "gt": ">", "le": "<=", "lt": "<"}


def plan_rows(plan: Plan) -> list[tuple[str, ...]]:
    """A row a launch: name, what opened it, stages, images read and written, bytes a pixel."""
    return [
        (
            launch.name,
            opener(launch),
            ", ".join(stages_of(launch)),
            reads_of(plan, launch),
            writes_of(plan, launch),
            f"{launch_bytes(plan, launch, 8):.1f}",
        )
        for launch in plan.launches
    ]


def opener(launch: AnyLaunch) -> str:
    """Why a launch is one of its own."""
    if isinstance(launch, Lines):
        return "row and column tables"
    if not isinstance(launch, Launch):
        return "reduction"
    if launch.stencil:
        return f"stencil, radius {launch.stencil.pass_.radius}"
    return "stored image" if launch.reads else "source"


def stages_of(launch: AnyLaunch) -> list[str]:
    """The steps in a launch, in order, each once; those redone at each tap are in brackets."""
    if isinstance(launch, Lines):
        return [op.step for op in launch.ops]
    if not isinstance(launch, Launch):
        return [launch.op.step]
    names = [f"({op.step})" for read in launch.reads for op in read.prologue]
    names += [op.step for op in launch.ops]
    if launch.sums:
        names.append(f"{launch.sums.step}: sums")
    return list(dict.fromkeys(names))


def slots_text(plan: Plan, number: int) -> str:
    """The slots of an image."""
    return ",".join(str(slot) for slot in plan.slots[number])


def reads_of(plan: Plan, launch: AnyLaunch) -> str:
    """What a launch reads."""
    if not isinstance(launch, Launch):
        return ""
    if not launch.reads:
        return f"source {plan.source.label}, {'half' if plan.half else 'float'}"
    return "; ".join(
        f"{r.image.kind.label} in {slots_text(plan, r.image.number)}" for r in launch.reads
    )


def writes_of(plan: Plan, launch: AnyLaunch) -> str:
    """What a launch writes."""
    if not isinstance(launch, Launch):
        return ""
    kept = {image.number: name for name, image in plan.kept}
    parts = []
    if launch.writes:
        text = f"{launch.writes.kind.label} in {slots_text(plan, launch.writes.number)}"
        parts.append(text + (" (kept)" if launch.writes.number in kept else ""))
    if launch.encodes:
        parts.append("8 bit")
    return "; ".join(parts)


def plan_record(plan: Plan) -> dict[str, Any]:
    """A plan as JSON values."""
    keys = ("launch", "opened_by", "stages", "reads", "writes", "bytes_per_pixel")
    return {
        "launches": [dict(zip(keys, row, strict=True)) for row in plan_rows(plan)],
        "slots": plan.slot_count,
        "bytes_per_pixel": plan.bytes_per_pixel(8),
        "kept": [name for name, _ in plan.kept],
    }


def type_text(annotation: Any) -> str:
    """A parameter's type, in a word."""
    if get_origin(annotation) is Literal:
        return " | ".join(map(str, get_args(annotation)))
    if get_origin(annotation) is Annotated:
        return type_text(get_args(annotation)[0])
    if get_origin(annotation) is tuple:
        return f"{len(get_args(annotation))} x {type_text(get_args(annotation)[0])}"
    if get_origin(annotation) in (Union, types.UnionType):
        return " | ".join(type_text(a) for a in get_args(annotation) if a is not type(None))
    return {"float": "number", "int": "whole number"}.get(annotation.__name__, annotation.__name__)


def value_text(value: Any) -> str:
    """A parameter's value, as TOML has it.

    >>> value_text((1.0, 2.5)), value_text("bayer"), value_text(False)
    ('[1, 2.5]', '"bayer"', 'false')
    """
    if isinstance(value, list | tuple):
        return f"[{', '.join(map(value_text, value))}]"
    if isinstance(value, float):
        return repr(int(value)) if value.is_integer() and abs(value) < 1e15 else repr(value)
    return json.dumps(value, ensure_ascii=False)


def parameter_rows(method: type[Method]) -> list[tuple[str, ...]]:
    """A row a parameter: name, default, unit, what is allowed, one sentence."""
    rows: list[tuple[str, ...]] = []
    for name, field in method.model_fields.items():
        extra: Any = field.json_schema_extra
        allowed = [type_text(field.annotation)]
        for limit in field.metadata:
            for key, sign in LIMITS.items():
                if (value := getattr(limit, key, None)) is not None:
                    allowed.append(f"{sign} {value:g}")
        default = extra["auto"] or value_text(field.default)
        rows.append((name, default, extra["unit"], ", ".join(allowed), field.description or ""))
    return rows


def stage_record(stage: Stage) -> dict[str, Any]:
    """A stage as JSON values."""
    keys = ("name", "default", "unit", "allowed", "text")
    return {
        "name": stage.name,
        "summary": stage.summary,
        "reads": stage.reads.label,
        "writes": stage.writes.label,
        "methods": [
            {
                "name": method.method,
                "summary": method.summary,
                "parameters": [dict(zip(keys, row, strict=True)) for row in parameter_rows(method)],
            }
            for method in stage.methods
        ],
    }


def device_rows(devices: Sequence[Found]) -> list[dict[str, Any]]:
    """A row a device with its status: used, usable, or why it is passed over; NumPy comes last."""
    try:
        used: Found | None = choose(None, list(devices))
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
            status = f"passed over: an earlier one serves; --device {device.index}"
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
                "status": status,
            }
        )
    numpy = "slow; --device numpy"
    blank = dict.fromkeys(("driver", "compute_units", "memory", "lanes"), "")
    rows.append(
        {"index": "numpy", "name": "NumPy", "platform": "the references", "type": "CPU"}
        | blank
        | {"status": numpy}
    )
    return rows
