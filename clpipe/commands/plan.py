"""``clpipe plan``: show the launches and buffers of a chain, or the source of a launch."""

from collections.abc import Mapping
from typing import Any

import click

from clpipe.base.errors import RequestError
from clpipe.base.text import unknown_name
from clpipe.chain.files import toml_text
from clpipe.chain.options import OPTIONS
from clpipe.commands.chain_options import chain_options, option, request_of
from clpipe.commands.options import Command, json_option
from clpipe.commands.printing import show, show_json
from clpipe.engine.codegen import write_kernel
from clpipe.engine.ir import AnyLaunch, Launch, Lines, Plan, reads_of
from clpipe.engine.plan import make_plan
from clpipe.engine.traffic import bytes_per_pixel, launch_bytes
from clpipe.outputs.recipes import results_of

LANES = 8  # vector lanes of the CPU for which sources and bytes are printed


@click.command("plan", cls=Command)
@chain_options
@option(OPTIONS["keep"])
@option(OPTIONS["format"], "formats")
@json_option
@click.option("--toml", "as_toml", is_flag=True, help="Print the chain as a configuration.")
@click.option("--source", metavar="LAUNCH", help="Print the OpenCL source of a launch.")
def plan(as_json: bool, as_toml: bool, source: str | None, **options: Any) -> None:
    """Show the launches and buffer slots of a chain, without running it.

    A launch is one kernel call over the image. A stage that reads only the pixel itself joins the
    previous launch. A stencil, a reduction or a kept image starts a new one. A slot is a buffer of
    one plane. For --source, name a launch or its number; the source is for a CPU with 8 lanes.
    """
    if (as_json, as_toml, source is not None).count(True) > 1:
        raise RequestError("--json, --toml and --source exclude each other; use only one of them")
    request = request_of(options)
    if as_toml:
        if request.start_at or request.until:
            raise RequestError(
                "--toml: it prints a whole chain as a configuration; remove --start-at and --until"
            )
        click.echo(toml_text(request.chain()), nl=False)
        return
    chain = request.chain()
    request = request.with_outputs(chain)
    keep, encode, final = results_of(chain, request.formats, request.keep)
    plan = make_plan(chain, half=True, keep=keep, encode=encode, final=final)
    if source is not None:
        click.echo(write_kernel(plan, launch_named(plan, source), LANES).source, nl=False)
        return
    if as_json:
        show_json(plan_record(plan))
        return
    headings = ("", "launch", "opened by", "stages", "reads", "writes", "bytes/px")
    show(headings, [(str(i), *row) for i, row in enumerate(plan_rows(plan), 1)])
    click.echo(
        f"\n{len(plan.launches)} launches, {plan.slot_count} slots, "
        f"{bytes_per_pixel(plan, LANES):.1f} bytes a pixel on the device"
    )


def launch_named(plan: Plan, wanted: str) -> AnyLaunch:
    """Return the launch of a plan with a number, from 1, or a name.

    Raises:
        RequestError: there is no such launch.
    """
    for number, launch in enumerate(plan.launches, 1):
        if wanted in (str(number), launch.name):
            return launch
    names = (f"{number} {launch.name}" for number, launch in enumerate(plan.launches, 1))
    raise RequestError(f"--source: {unknown_name('launch', wanted, names)}")


def plan_rows(plan: Plan) -> list[tuple[str, ...]]:
    """Return a row for each launch: name, cause, stages, images read and written, bytes a pixel."""
    kept = {image.number: name for name, image in plan.kept}
    return [
        (
            launch.name,
            opener(launch, kept),
            ", ".join(stages_of(launch)),
            reads_text(plan, launch),
            writes_text(plan, launch),
            f"{launch_bytes(plan, launch, LANES):.1f}",
        )
        for launch in plan.launches
    ]


def opener(launch: AnyLaunch, kept: Mapping[int, str]) -> str:
    """Return why a launch does not join the previous one: the stage and its reason."""
    if isinstance(launch, Lines):
        return "tables of rows and columns"
    if not isinstance(launch, Launch):
        return f"{launch.op.step}: {'histogram' if launch.op.reduction.bins else 'sums'}"
    if op := launch.opener:
        access = f"stencil, radius {op.radius}" if launch.stencil else "resample"
        return f"{op.step}: {access}"
    if not launch.reads:
        return "source"
    if name := kept.get(launch.reads[0].image.number):
        return f"{name} is kept"
    return f"{launch.ops[0].step if launch.ops else 'end'}: stored image"


def stages_of(launch: AnyLaunch) -> list[str]:
    """Return the steps in a launch, in order. Steps repeated at each tap are in brackets."""
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
    """Return the slots of an image as text."""
    return ",".join(str(slot) for slot in plan.slots[number])


def reads_text(plan: Plan, launch: AnyLaunch) -> str:
    """Return the images that a launch reads, as text."""
    if isinstance(launch, Launch) and not launch.reads:
        return f"source {plan.source.label}, {'half' if plan.half else 'float'}"
    return "; ".join(
        f"{r.image.kind.label} in {slots_text(plan, r.image.number)}" for r in reads_of(launch)
    )


def writes_text(plan: Plan, launch: AnyLaunch) -> str:
    """Return the images that a launch writes, as text."""
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
    """Return a plan as JSON values."""
    keys = ("launch", "opened_by", "stages", "reads", "writes", "bytes_per_pixel")
    return {
        "launches": [dict(zip(keys, row, strict=True)) for row in plan_rows(plan)],
        "slots": plan.slot_count,
        "bytes_per_pixel": bytes_per_pixel(plan, LANES),
        "kept": [name for name, _ in plan.kept],
    }
