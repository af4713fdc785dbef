"""Looks: combine the raw of one configuration with the development of another.

A configuration with ``stages`` is a whole chain. If it overrides another configuration, it is a
look: it replaces the steps after the raw, and the steps that make the raw stay.
"""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

from clpipe.chain.keys import KEYS, NOISE, TABLES, setting_error, string_list
from clpipe.chain.methods import stage_named, step_names_of
from clpipe.chain.settings import Settings, overlay
from clpipe.stage import Kind


def override_settings(base: Settings, values: Mapping[str, Any]) -> Settings:
    """Return settings overridden by a configuration, or by its development if it has ``stages``.

    With ``stages``, the steps after the raw are those of the configuration, with their values,
    draws and skips. They are renamed to fit the new chain. The configuration's steps up to the raw
    are ignored. All other values, such as camera and ISO, override the settings by
    :func:`~clpipe.chain.settings.overlay`. So do all values of a configuration without ``stages``.

    Args:
        base: the settings to override.
        values: the values of a configuration, nested as in its file.

    Raises:
        KeyedError: one of the two chains has no raw, or a value is not allowed.
    """
    if "stages" not in values:
        return overlay(base, values)
    override_stages = string_list(values, "stages", "stage names")
    raw, first = base.stages[: first_after_raw(base.stages)], first_after_raw(override_stages)
    stages = (*raw, *override_stages[first:])
    developing = dict(
        zip(step_names_of(override_stages)[first:], step_names_of(stages)[len(raw) :], strict=True)
    )
    return overlay(_raw_settings(base, raw, stages), _development_values(values, developing))


def first_after_raw(stages: Sequence[str]) -> int:
    """Return the index of the first stage after the raw in a chain's stages.

    >>> first_after_raw(["exposure", "mosaic", "quantize", "normalize", "demosaic"])
    3

    Raises:
        KeyedError: no stage makes a raw.
    """
    makers = [n for n, name in enumerate(stages) if stage_named("stages", name).writes is Kind.RAW]
    if not makers:
        raise setting_error(
            f"stages: found {', '.join(stages)}, but none of these stages produces a raw. To "
            "combine this development with another configuration's raw, add quantize"
        )
    return makers[-1] + 1


def _raw_settings(settings: Settings, raw: Sequence[str], stages: tuple[str, ...]) -> Settings:
    """Return settings with other stages. Only values of the steps that make the raw are kept."""
    names = {*step_names_of(raw), *TABLES, ""}
    skip = tuple(name for name in settings.skip if name in names or name == NOISE)
    parameters = {step: table for step, table in settings.parameters.items() if step in names}
    validated = {step: table for step, table in settings.validated.items() if step in names}
    draws = {k: draw for k, draw in settings.draws.items() if k.rpartition(".")[0] in names}
    return replace(
        settings, stages=stages, skip=skip, parameters=parameters, validated=validated, draws=draws
    )


def _development_values(values: Mapping[str, Any], names: Mapping[str, str]) -> dict[str, Any]:
    """Return the values of a configuration, without its stages and the values of its raw.

    Args:
        values: the values, nested as in its file.
        names: the new names of the steps after the raw, by their names in its own chain.
    """
    result: dict[str, Any] = {}
    for key, value in values.items():
        if key == "skip":
            skipped = string_list(values, key, "stage names")
            result[key] = [names.get(n, n) for n in skipped if n in names or n == NOISE]
        elif key in names:
            result[names[key]] = {k: _renamed_followers(v, names) for k, v in value.items()}
        elif key in KEYS and key != "stages":
            result[key] = value
        elif key in TABLES:
            result[key] = {k: _renamed_followers(v, names) for k, v in value.items()}
    return result


def _renamed_followers(value: Any, names: Mapping[str, str]) -> Any:
    """Return a value. A draw that follows a parameter of a renamed step follows the new name."""
    if not isinstance(value, Mapping):
        return value
    followed = {k: v.partition(".") for k, v in value.items() if isinstance(v, str)}
    return {**value, **{k: f"{names.get(s, s)}{dot}{n}" for k, (s, dot, n) in followed.items()}}
