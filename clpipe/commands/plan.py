"""``clpipe plan``: show the launches and buffers of a chain, or the source of a launch."""

from collections.abc import Iterator, Mapping
from typing import Any

import click

from clpipe.base.errors import RequestError
from clpipe.base.text import unknown_name
from clpipe.chain.files import toml_text
from clpipe.commands.chain_options import chain_options, format_option, options, request_of
from clpipe.commands.options import Command, json_option
from clpipe.commands.printing import show, show_json
from clpipe.engine.bands import BAND, schedule_of
from clpipe.engine.codegen import write_kernel
from clpipe.engine.hardware import USUAL_CACHE
from clpipe.engine.ir import AnyLaunch, Cpu, Image, Launch, Lines, Plan, reads_of
from clpipe.engine.plan import make_plan
from clpipe.engine.traffic import bytes_per_pixel, launch_bytes
from clpipe.outputs.recipes import required_results

# The CPU for which the plan, sources and bytes are printed.
LANES = 8
CPU = Cpu(cores=2, cache=USUAL_CACHE)


@click.command("plan", cls=Command)
@chain_options
@options("keep")
@format_option
@json_option
@click.option("--toml", "as_toml", is_flag=True, help="Print the chain as a configuration.")
@click.option("--source", metavar="LAUNCH", help="Print the OpenCL source of a launch.")
def plan(as_json: bool, as_toml: bool, source: str | None, **options: Any) -> None:
    """Show the launches and buffer slots of a chain, without running it.

    A launch is one kernel call over the image. A stage that reads only the pixel itself joins the
    previous launch. A stencil, a reduction or a kept image starts a new one. On a CPU, consecutive
    launches run together, band by band, and only some rows between them are stored. A GPU runs each
    over the whole image. A slot is a buffer of one plane. For --source, name a launch or its
    number; the source is for a CPU with 8 lanes.
    """
    if (as_json, as_toml, source is not None).count(True) > 1:
        raise RequestError("--json, --toml and --source exclude each other; use only one of them")
    request = request_of(options)
    if as_toml:
        if request.start_at or request.until:
            raise RequestError(
                "--toml: this option prints a whole chain as a configuration; remove "
                "--start-at and --until"
            )
        click.echo(toml_text(request.chain()), nl=False)
        return
    chain = request.chain()
    request = request.with_outputs(chain)
    keep, encode, final = required_results(chain, request.formats, request.keep)
    plan = make_plan(chain, half=True, keep=keep, encode=encode, final=final, cpu=CPU)
    if source is not None:
        launch = launch_named(plan, source)
        if launch not in plan.launches:  # a part of bands: print it as for a GPU
            plan = make_plan(chain, half=True, keep=keep, encode=encode, final=final)
        click.echo(write_kernel(plan, launch, LANES).source, nl=False)
        return
    if as_json:
        show_json(plan_record(plan))
        return
    headings = ("", "launch", "opened by", "stages", "reads", "writes", "bytes/px")
    show(headings, [(n, *plan_row(plan, launch)) for n, launch in numbered(plan)])
    click.echo(
        f"\nLaunches: {len(plan.launches)}. Slots: {plan.slot_count}. "
        f"Memory on the device: {bytes_per_pixel(plan, LANES):.1f} bytes per pixel."
    )
    for number, launch in numbered(plan):
        if isinstance(launch, Launch) and launch.bands:
            click.echo(
                f"Launch {number} runs in bands of {BAND} rows. Between its parts, it stores "
                f"{schedule_of(launch.bands).rows * 4} bytes per column of a strip."
            )


def launch_named(plan: Plan, name_or_number: str) -> AnyLaunch:
    """Return the launch of a plan with a number, from 1, or a name.

    Raises:
        RequestError: there is no such launch.
    """
    for number, launch in numbered(plan):
        if name_or_number in (number, launch.name):
            return launch
    names = (f"{number} {launch.name}" for number, launch in numbered(plan))
    raise RequestError(f"--source: {unknown_name('launch', name_or_number, names)}")


def numbered(plan: Plan) -> Iterator[tuple[str, AnyLaunch]]:
    """Yield the launches with their numbers, each followed by those that it runs in bands."""
    for number, launch in enumerate(plan.launches, 1):
        yield str(number), launch
        if isinstance(launch, Launch) and launch.bands:
            for part, inner in enumerate(launch.bands.parts, 1):
                yield f"{number}.{part}", inner


def plan_row(plan: Plan, launch: AnyLaunch) -> tuple[str, ...]:
    """Return name, cause, stages, images read and written, and bytes a pixel of a launch."""
    kept = {image.number: name for name, image in plan.kept}
    is_joined = isinstance(launch, Launch) and launch.bands
    return (
        launch.name,
        "bands" if is_joined else opener(launch, kept),
        "" if is_joined else ", ".join(stages_of(launch)),
        reads_text(plan, launch),
        writes_text(plan, launch),
        f"{launch_bytes(plan, launch, LANES):.1f}" if launch in plan.launches else "",
    )


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


def image_text(plan: Plan, image: Image) -> str:
    """Return the kind of an image and where it is stored, as text."""
    if slots := plan.slots[image.number]:
        return f"{image.kind.label} in {','.join(map(str, slots))}"
    rings = (schedule_of(x.bands).rings for x in plan.launches if isinstance(x, Launch) and x.bands)
    rows = next(ring[image.number].rows for ring in rings if image.number in ring)
    return f"{image.kind.label}, {rows} rows"


def reads_text(plan: Plan, launch: AnyLaunch) -> str:
    """Return the images that a launch reads, as text."""
    if isinstance(launch, Launch) and not launch.reads:
        return f"source {plan.source.label}, {'half' if plan.half else 'float'}"
    return "; ".join(image_text(plan, read.image) for read in reads_of(launch))


def writes_text(plan: Plan, launch: AnyLaunch) -> str:
    """Return the images that a launch writes, as text."""
    if not isinstance(launch, Launch):
        return ""
    kept = {image.number: name for name, image in plan.kept}
    parts = []
    if launch.writes:
        text = image_text(plan, launch.writes)
        parts.append(text + (" (kept)" if launch.writes.number in kept else ""))
    if launch.encodes:
        parts.append("8 bit")
    return "; ".join(parts)


def plan_record(plan: Plan) -> dict[str, Any]:
    """Return a plan as JSON values."""
    keys = ("number", "launch", "opened_by", "stages", "reads", "writes", "bytes_per_pixel")
    return {
        "launches": [
            dict(zip(keys, (number, *plan_row(plan, launch)), strict=True))
            for number, launch in numbered(plan)
        ],
        "slots": plan.slot_count,
        "bytes_per_pixel": bytes_per_pixel(plan, LANES),
        "kept": [name for name, _ in plan.kept],
    }
