"""Looks: combine the raw of one configuration with the development of another.

A configuration with ``stages`` is a whole chain. If it overrides another configuration, it is a
look: it replaces the steps after the raw, and the steps that make the raw stay.
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
    """Return settings overridden by a configuration, or by its development if it has ``stages``.

    With ``stages``, the steps after the raw are those of the configuration, with their values,
    draws and skips. They are renamed to fit the new chain. The configuration's steps up to the raw
    are ignored. All other values, such as camera and ISO, override the settings by
    :func:`~clpipe.chain.settings.overlay`. So do all values of a configuration without ``stages``.

    Args:
        before: the settings to override.
        values: the values of a configuration, nested as in its file.

    Raises:
        KeyedError: one of the two chains has no raw, or a value is not allowed.
    """
    if "stages" not in values:
        return overlay(before, values)
    own = names_in(values, "stages", "stage names")
    raw, first = before.stages[: behind_raw(before.stages)], behind_raw(own)
    stages = (*raw, *own[first:])
    developing = dict(zip(numbered(own)[first:], numbered(stages)[len(raw) :], strict=True))
    return overlay(_raw_alone(before, raw, stages), _development(values, developing))


def behind_raw(stages: Sequence[str]) -> int:
    """Return the index of the first stage after the raw in a chain's stages.

    >>> behind_raw(["exposure", "mosaic", "quantize", "normalize", "demosaic"])
    3

    Raises:
        KeyedError: no stage makes a raw.
    """
    makers = [n for n, name in enumerate(stages) if stage_named("stages", name).writes is Kind.RAW]
    if not makers:
        raise KeyedError(
            "stages",
            f"stages: found {', '.join(stages)}, but none of these makes the raw, so there is no "
            "development to combine with another configuration's raw; add quantize",
        )
    return makers[-1] + 1


def _raw_alone(settings: Settings, raw: Sequence[str], stages: tuple[str, ...]) -> Settings:
    """Return settings with other stages. Only values of the steps that make the raw are kept."""
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
    """Return the values of a configuration, without its stages and the values of its raw.

    Args:
        values: the values, nested as in its file.
        names: the new names of the steps after the raw, by their names in its own chain.
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
    """Return a value. A draw that follows a parameter of a renamed step follows the new name."""
    if not isinstance(value, Mapping):
        return value
    followed = {k: v.partition(".") for k, v in value.items() if isinstance(v, str)}
    return {**value, **{k: f"{names.get(s, s)}{dot}{n}" for k, (s, dot, n) in followed.items()}}
