"""``clpipe stages``: list the stages, or explain the methods and parameters of one."""

import types
from pathlib import Path
from typing import Annotated, Any, Literal, Union, get_args, get_origin

import click
from pydantic import ValidationError

from clpipe.base.errors import ClpipeError, RequestError
from clpipe.base.text import unknown_name
from clpipe.chain.keys import CODE, KEYS
from clpipe.chain.making import make_chain
from clpipe.chain.registry import all_stages, load_stage_file
from clpipe.chain.request import DEFAULTS
from clpipe.chain.settings import Settings, overlay
from clpipe.chain.toml import value_text
from clpipe.commands.chain_options import options, settings_in
from clpipe.commands.completion import steps
from clpipe.commands.options import Command, json_option
from clpipe.commands.printing import short_text, show, show_json
from clpipe.stage import Context, Kind, Method, Stage

LIMITS = {"ge": ">=", "gt": ">", "le": "<=", "lt": "<"}


@click.command("stages", cls=Command)
@click.argument("name", required=False, shell_complete=steps)
@options(KEYS["camera"], KEYS["iso"], CODE)
@json_option
def stages(name: str | None, stage_files: tuple[Path, ...], as_json: bool, **values: Any) -> None:
    """List the stages, or explain the methods and parameters of one.

    Automatic parameters are shown with their values for the camera and the ISO.
    """
    for file in stage_files:
        load_stage_file(file)
    if name is not None and name not in all_stages():
        raise RequestError(unknown_name("stage", name, all_stages()))
    settings = overlay(DEFAULTS, settings_in(values))
    selected = [all_stages()[name]] if name else list(all_stages().values())
    if as_json:
        records = [stage_record(s, context_for(s, settings)) for s in selected]
        show_json({"stages": records})
    elif name is None:
        headings = ("stage", "reads", "writes", "what it does", "methods (first is default)")
        show(headings, map(stage_row, selected))
    else:
        explain_stage(selected[0], settings)


def type_text(annotation: Any) -> str:
    """Return the type of a parameter in words."""
    if get_origin(annotation) is Literal:
        return " | ".join(map(str, get_args(annotation)))
    if get_origin(annotation) is Annotated:
        return type_text(get_args(annotation)[0])
    if get_origin(annotation) is tuple:
        first, *more = get_args(annotation)
        if Ellipsis in more:
            return f"list of {type_text(first)}s"
        return f"{1 + len(more)} x {type_text(first)}"
    if get_origin(annotation) in (Union, types.UnionType):
        return " | ".join(type_text(a) for a in get_args(annotation) if a is not type(None))
    return {"float": "number", "int": "whole number"}.get(annotation.__name__, annotation.__name__)


def resolved(method: type[Method], context: Context) -> dict[str, str]:
    """Return the values of a method's automatic parameters in a context, as text."""
    automatic = [name for name, field in method.model_fields.items() if field.default is None]
    try:
        values = method().resolve(context)
    except (ValidationError, ClpipeError):  # a parameter has no default
        automatic = [name for name in automatic if name not in method.example]
        try:
            values = method.model_validate(method.example).resolve(context)
        except ClpipeError as error:
            return dict.fromkeys(automatic, str(error))
    return {name: short_text(getattr(values, name, None)) for name in automatic}


def context_for(stage: Stage, settings: Settings) -> Context:
    """Return the context of a stage in the default chain.

    A stage that the chain does not contain gets the context of a stage with the same input.
    """
    steps = make_chain(settings).steps
    of_stage = [step.context for step in steps if step.stage is stage]
    same_kind = [step.context for step in steps if step.stage.reads is stage.reads]
    return [steps[0].context, *same_kind, *of_stage][-1]


def parameter_rows(method: type[Method]) -> list[tuple[str, ...]]:
    """Return a row for each parameter: name, default, unit, allowed values, one sentence."""
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


def stage_record(stage: Stage, context: Context) -> dict[str, Any]:
    """Return a stage as JSON values, with the values of automatic parameters in a context."""
    keys = ("name", "default", "unit", "allowed", "text")
    return {
        "name": stage.name,
        "summary": stage.summary,
        "reads": kinds_text(stage.reads, stage),
        "writes": kinds_text(stage.writes, stage),
        "methods": [
            {
                "name": method.method,
                "summary": method.summary,
                "parameters": [dict(zip(keys, row, strict=True)) for row in parameter_rows(method)],
                "automatic": resolved(method, context),
            }
            for method in stage.methods
        ],
    }


def stage_row(stage: Stage) -> tuple[str, ...]:
    """Return the row of a stage: name, kinds read and written, summary, methods."""
    methods = ", ".join(stage.by_name)
    kinds = (kinds_text(kind, stage) for kind in (stage.reads, stage.writes))
    return stage.name, *kinds, stage.summary, methods


def kinds_text(kind: Kind, stage: Stage) -> str:
    """Return the kind of image that a stage reads or writes, and the kinds allowed instead."""
    return " or ".join(each.label for each in (kind, *stage.also_reads))


def explain_stage(stage: Stage, settings: Settings) -> None:
    """Print the methods and parameters of a stage, with their values for a camera and an ISO."""
    context = context_for(stage, settings)
    reads, writes = (kinds_text(kind, stage) for kind in (stage.reads, stage.writes))
    click.echo(f"{stage.name}: {stage.summary} Reads {reads}, writes {writes}.")
    condition = f"{context.camera.name}, ISO {context.iso:g}"
    for method in stage.methods:
        click.echo(f"\nmethod {method.method}: {method.summary}")
        rows = parameter_rows(method)
        automatic = resolved(method, context)
        headings = ["parameter", "default", "unit", "allowed", ""]
        if automatic:
            headings.insert(2, condition)
            rows = [(row[0], row[1], automatic.get(row[0], ""), *row[2:]) for row in rows]
        if rows:
            show(headings, rows)
    if stage.explain:
        click.echo(f"\n{stage.explain(context)}")
