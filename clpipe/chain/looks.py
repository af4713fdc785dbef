"""Looks: configurations over others, the way to the raw by one and the development by the next.

A configuration with ``stages`` of its own is a whole chain. Over another one it is a look: of its
steps those behind the raw count, and the steps that make the raw stay.
"""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

from clpipe.base.errors import KeyedError
from clpipe.chain.keys import KEYS, NOISE, TABLES, names_in
from clpipe.chain.methods import numbered, stage_named
from clpipe.chain.settings import Settings, overlay
from clpipe.stage import Kind


def laid_over(before: Settings, values: Mapping[str, Any]) -> Settings:
    """Settings with a configuration over them; where it has ``stages``, with its development.

    Then the steps behind the raw are its own, with their values, draws and skips, under the names
    that they get in the new chain. What it has of steps that make its raw is left out. All else, as
    the camera, the ISO and a configuration without ``stages``, is laid over by
    :func:`~clpipe.chain.settings.overlay`.

    Args:
        before: what holds where the configuration has nothing.
        values: of a configuration, nested as in its file.

    Raises:
        KeyedError: one of both chains has no raw, or a value is not allowed.
    """
    if "stages" not in values:
        return overlay(before, values)
    own = names_in(values, "stages", "stage names")
    raw, first = before.stages[: behind_raw(before.stages)], behind_raw(own)
    stages = (*raw, *own[first:])
    developing = dict(zip(numbered(own)[first:], numbered(stages)[len(raw) :], strict=True))
    return overlay(_raw_alone(before, raw, stages), _development(values, developing))


def behind_raw(stages: Sequence[str]) -> int:
    """The place in a chain's stages of the first that develops its raw.

    >>> behind_raw(["exposure", "mosaic", "quantize", "normalize", "demosaic"])
    3

    Raises:
        KeyedError: no stage makes a raw.
    """
    makers = [n for n, name in enumerate(stages) if stage_named("stages", name).writes is Kind.RAW]
    if not makers:
        raise KeyedError(
            "stages",
            f"stages: found {', '.join(stages)}, of which none makes the raw (quantize does), so "
            "none begins the development that goes behind another configuration's raw",
        )
    return makers[-1] + 1


def _raw_alone(settings: Settings, raw: Sequence[str], stages: tuple[str, ...]) -> Settings:
    """Settings of other stages, with nothing left of steps but of those that make the raw."""
    names = {*numbered(raw), *TABLES, ""}
    skip = tuple(name for name in settings.skip if name in names or name == NOISE)
    parameters = {step: table for step, table in settings.parameters.items() if step in names}
    validated = {step: table for step, table in settings.validated.items() if step in names}
    draws = {k: draw for k, draw in settings.draws.items() if k.rpartition(".")[0] in names}
    return replace(
        settings,
        stages=stages,
        skip=skip,
        parameters=parameters,
        validated=validated,
        draws=draws,
    )


def _development(values: Mapping[str, Any], names: Mapping[str, str]) -> dict[str, Any]:
    """The values of a configuration without its stages and what belongs to its raw.

    Args:
        values: nested, as in its file.
        names: of the steps that develop, in its own chain, and what they are called now.
    """
    taken: dict[str, Any] = {}
    for key, value in values.items():
        if key == "skip":
            skipped = names_in(values, key, "stage names")
            taken[key] = [names.get(n, n) for n in skipped if n in names or n == NOISE]
        elif key in names:
            taken[names[key]] = {k: _following(v, names) for k, v in value.items()}
        elif key in KEYS and key != "stages":
            taken[key] = value
        elif key in TABLES:
            taken[key] = {k: _following(v, names) for k, v in value.items()}
    return taken


def _following(value: Any, names: Mapping[str, str]) -> Any:
    """A value; a draw that follows a step's parameter by the name that the step has now."""
    if not isinstance(value, Mapping):
        return value
    followed = {k: v.partition(".") for k, v in value.items() if isinstance(v, str)}
    return {**value, **{k: f"{names.get(s, s)}{dot}{n}" for k, (s, dot, n) in followed.items()}}
