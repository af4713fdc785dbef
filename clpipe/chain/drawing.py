"""TODO."""

import zlib
from collections.abc import Callable, Container, Iterable, Mapping, Sequence
from functools import partial
from itertools import product
from typing import TYPE_CHECKING, Any

import numpy as np
from pydantic import BaseModel

from clpipe.base.errors import KeyedError
from clpipe.base.text import one_of
from clpipe.camera.profile import load_camera
from clpipe.chain.draws import TINY, Choice, Draw, Limits, limits_of, parse_draw
from clpipe.chain.keys import DRAWN, KEYS, OUTPUT, check_type
from clpipe.chain.methods import (
    base_name,
    make_method,
    make_output,
    method_named,
    method_of,
    stage_named,
    unknown_parameter,
)
from clpipe.images.encoding import Output
from clpipe.reference.random import philox, stream_of

if TYPE_CHECKING:
    from clpipe.chain.settings import Settings


def ordered(draws: Mapping[str, Draw], given: Mapping[str, Any]) -> list[str]:
    """The names of what is drawn, each after what it follows; ``given`` is what has a value.

    Raises:
        KeyedError: one follows what is neither drawn nor given, or itself in the end.
    """

    def depth(key: str) -> int:
        path = [key]
        while (of := draws[path[-1]].follows) in draws:
            path.append(of)
            if of in path[:-1]:
                raise KeyedError(key, f"{key}: it follows itself: {' -> '.join(path)}")
        if of and of not in given:
            known = sorted({*given, *draws} - {path[-1]})
            wrong = one_of("value", of, known).replace("allowed", "drawn or given are")
            raise KeyedError(path[-1], f"{path[-1]}: {wrong}")
        return len(path)

    return sorted(draws, key=depth)


LimitsOf = Callable[[str], Limits | None]


def extremes_of(
    draws: Mapping[str, Draw], given: Mapping[str, Any], limits: LimitsOf
) -> dict[str, Sequence[Any]]:
    """For each draw, values that are all allowed only if every one is that can be drawn.

    Args:
        draws: by the name of what is drawn.
        given: what has a value, by its name.
        limits: of what has that name.

    Raises:
        KeyedError: a law cannot draw what it is to draw; and as :func:`ordered`.
    """
    found: dict[str, Sequence[Any]] = {}
    for key in ordered(draws, given):
        draw = draws[key]
        followed = (
            found[draw.follows]
            if draw.follows in found
            else [given[draw.follows]]
            if draw.follows
            else []
        )
        try:
            found[key] = draw.extremes(limits(key), followed)
        except ValueError as error:
            raise KeyedError(key, f"{key}: found {draw.record()}: {error}") from None
    return found


def values_of(
    draws: Mapping[str, Draw], given: Mapping[str, Any], limits: LimitsOf, owner: str
) -> dict[str, Any]:
    """The values that belong to an owner (seed and image key); arguments as :func:`extremes_of`."""
    known = dict(given)
    numbers = uniforms(owner, draws)
    for key in ordered(draws, given):
        draw = draws[key]
        known[key] = draw.value(numbers[key], limits(key), known.get(draw.follows))
    return {key: known[key] for key in draws}


def uniforms(owner: str, names: Iterable[str]) -> dict[str, float]:
    """A number above 0 and below 1 for each name, of 52 bits, by Philox keyed on the owner.

    >>> {name: round(u, 3) for name, u in uniforms("draw:0:a.exr", ["iso", "camera"]).items()}
    {'iso': 0.282, 'camera': 0.608}
    """
    listed = list(names)
    stage = np.array([zlib.crc32(name.encode()) for name in listed], np.uint32)
    zero = np.zeros(1, np.uint32)
    high, low, *_ = philox(zero, zero, zero, stage, stream_of(owner, ""))
    bits = (high.astype(np.uint64) << np.uint64(20)) | (low.astype(np.uint64) >> np.uint64(12))
    return dict(zip(listed, ((bits + 0.5) * 2.0**-52).tolist(), strict=True))


def draw_of(key: str, table: Mapping[str, Any]) -> Draw:
    """The draw that stands in the place of a value.

    Raises:
        KeyedError: it is none, or not for such a value.
    """
    if key in KEYS and key not in DRAWN:
        drawn = f"{', '.join(DRAWN)} and the parameters of stages can"
        raise KeyedError(key, f"{key}: found {dict(table)!r}, but it cannot be drawn; {drawn}")
    draw = parse_draw(key, table)
    if (key == "camera" or key.endswith(".method")) and not isinstance(draw, Choice):
        raise KeyedError(key, f"{key}: found {dict(table)!r}, but it is drawn by choice")
    return draw


def models_at(settings: "Settings", step: str) -> list[type[BaseModel]]:
    """What declares the parameters of a step: its method, or all that its method is drawn from.

    Raises:
        KeyedError: there is no such method.
    """
    if step == OUTPUT:
        return [Output]
    draw = settings.draws.get(f"{step}.method")
    table = settings.parameters.get(step, {})
    names = draw.choice if isinstance(draw, Choice) else [method_of(step, table)]
    return [method_named(stage_named(step, base_name(step)), step, name) for name in names]


def limits_at(settings: "Settings", key: str, isos: Limits) -> Limits | None:
    """The limits of what may be drawn, by its dotted name; those of the ISO are given."""
    step, _, name = key.partition(".")
    if key in ("iso", "camera") or name == "method":
        return isos if key == "iso" else None
    return limits_of(models_at(settings, step)[0], name)


def check_draws(settings: "Settings", changed: Container[str]) -> None:
    """See that all that can be drawn is allowed, each with the others at one of their extremes.

    Args:
        settings: with draws.
        changed: the keys and steps that are new; others were checked before. What follows something
            is checked again.

    Raises:
        KeyedError: it is not.
    """
    by_step: dict[str, dict[str, Sequence[Any]]] = {}
    steps = {key.partition(".")[0] for key, draw in settings.draws.items() if draw.follows}
    for key in settings.draws:
        step, _, name = key.partition(".")
        for model in models_at(settings, step) if name and step in changed else ():
            if name not in ("method", *model.model_fields):
                raise unknown_parameter(step, model, name)
    limits = partial(limits_at, settings, isos=Limits(low=TINY))
    for key, values in extremes_of(settings.draws, settings.given(), limits).items():
        step, _, name = key.partition(".")
        if not name:
            for value in values:
                check_type(key, value)
        elif step in changed or step in steps:
            by_step.setdefault(step, {})[name] = values
    for step, drawn in by_step.items():
        given = {k: v for k, v in settings.table(step).items() if not isinstance(v, Draw)}
        first = {name: values[0] for name, values in drawn.items()}
        methods = [{"method": method} for method in drawn.pop("method", ())] or [{}]
        others = [{name: value} for name, values in drawn.items() for value in values] or [{}]
        for method, other in product(methods, others):
            table = {**given, **first, **method, **other}
            if step == OUTPUT:
                make_output(table)
            else:
                make_method(stage_named(step, base_name(step)), step, table)


def cameras_of(settings: "Settings") -> list[str]:
    """The cameras that there can be."""
    draw = settings.draws.get("camera")
    return list(draw.choice) if isinstance(draw, Choice) else [settings.camera]


def isos_of(settings: "Settings") -> Limits:
    """The ISOs that all these cameras have.

    Raises:
        RequestError: a camera cannot be loaded.
    """
    ranges = [load_camera(name).iso_range for name in cameras_of(settings)]
    return Limits(max(low for low, _ in ranges), min(high for _, high in ranges))


def check_camera(settings: "Settings") -> None:
    """See that every camera that there can be is there, and has every ISO that there can be.

    Raises:
        RequestError: one is not, or has not.
    """
    isos: Sequence[float] = [settings.iso]
    if "iso" in settings.draws:
        limits = partial(limits_at, settings, isos=isos_of(settings))
        isos = extremes_of(settings.draws, settings.given(), limits)["iso"]
    for camera, iso in product(map(load_camera, cameras_of(settings)), isos):
        camera.gain_stage(iso)
