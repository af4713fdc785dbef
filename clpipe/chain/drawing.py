"""Random draws in place of values: their order, their extremes, and the values of an image.

The distributions are in :mod:`clpipe.chain.draws`.
"""

import zlib
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from itertools import product
from typing import Any

from clpipe.base.text import unknown_name
from clpipe.base.types import plain
from clpipe.chain.draws import Choice, Draw, Drift, parse_draw
from clpipe.chain.keys import KEYS, setting_error
from clpipe.chain.lens_presets import PRESETS
from clpipe.chain.limits import Limits
from clpipe.reference.random import philox_rounds, stream_of

LimitsOf = Callable[[str], Limits | None]  # returns the limits of the value with a dotted name


def parse_drawn(key: str, table: Mapping[str, Any]) -> Draw:
    """Return the draw that a table declares in place of a value.

    Raises:
        KeyedError: the table is no draw, or the value cannot be drawn from it.
    """
    if key in KEYS and not KEYS[key].is_drawn:
        drawn = ", ".join(known.name for known in KEYS.values() if known.is_drawn)
        allowed = f"{drawn} and the parameters of stages can be"
        raise setting_error(
            f"{key}: found {dict(table)!r}, but {key} cannot be drawn; only {allowed}"
        )
    draw = parse_draw(key, table)
    if key == "lens" and isinstance(draw, Choice) and (presets := PRESETS.keys() & draw.choice):
        raise setting_error(
            f"lens: found {dict(table)!r}, but {sorted(presets)[0]!r} is no lens of lensfun's "
            "database, and cannot be drawn; remove it"
        )
    if (key == "camera" or key.endswith(".method")) and not isinstance(draw, Choice):
        raise setting_error(
            f"{key}: found {dict(table)!r}, but a name can only be drawn by choice; "
            "use {choice = ['A', 'B']}"
        )
    return draw


def with_iso_range(values: Mapping[str, Any]) -> dict[str, Any]:
    """Return settings whose ISO is a draw if it is a range: a text, or a tuple of two numbers.

    >>> with_iso_range({"iso": "100..6400"}) == with_iso_range({"iso": (100, 6400)})
    True
    >>> with_iso_range({"iso": "100..6400"})
    {'iso': {'log_uniform': [100.0, 6400.0]}}

    Raises:
        KeyedError: a range has no two numbers.
    """
    found = values.get("iso")
    ends = tuple(found.split("..")) if isinstance(found, str) and ".." in found else found
    if not isinstance(ends, tuple):
        return dict(values)
    try:
        low, high = map(float, ends)
    except ValueError:
        raise setting_error(
            f"iso: found {found!r}; expected the two ends of a range of random ISOs, such as "
            "'100..6400' or (100, 6400); for a series, use a list"
        ) from None
    return {**values, "iso": {"log_uniform": [low, high]}}


def plain_settings(values: Mapping[str, Any]) -> dict[str, Any]:
    """Return settings from Python as those of a configuration file: plain values, ISO ranges."""
    found: dict[str, Any] = plain(with_iso_range(values))
    return found


def draw_order(draws: Mapping[str, Draw], constants: Mapping[str, Any]) -> list[str]:
    """Return the names of the draws, each after the value that it follows.

    Args:
        draws: the draws, by the dotted name of the drawn value.
        constants: the values that are not drawn, by dotted name.

    Raises:
        KeyedError: a draw follows a name that has no value, or follows itself through others.
    """

    def depth(key: str) -> int:
        path = [key]
        while (leader := draws[path[-1]].follows) in draws:
            path.append(leader)
            if leader in path[:-1]:
                raise setting_error(
                    f"{key}: the draw follows itself: {' -> '.join(path)}; "
                    "set one of these to a value"
                )
        if leader and leader not in constants:
            names = sorted({*constants, *draws} - {path[-1]})
            unknown = unknown_name("value", leader, names).replace("allowed", "set or drawn are")
            raise setting_error(f"{path[-1]}: {unknown}")
        return len(path)

    return sorted(draws, key=depth)


def draw_extremes(
    draws: Mapping[str, Draw], constants: Mapping[str, Any], limits: LimitsOf
) -> dict[str, Sequence[Any]]:
    """Return the extreme values of each draw. If they are allowed, every drawn value is.

    Args:
        draws: as for :func:`draw_order`.
        constants: as for :func:`draw_order`.
        limits: returns the limits of a value by its dotted name.

    Raises:
        KeyedError: a draw does not fit its limits or the value that it follows, or as for
            :func:`draw_order`.
    """
    extremes: dict[str, Sequence[Any]] = {}
    for key in draw_order(draws, constants):
        draw, leader = draws[key], draws[key].follows
        followed: Sequence[Any] = []
        if leader:
            followed = extremes[leader] if leader in extremes else [constants[leader]]
        try:
            extremes[key] = draw.extremes(limits(key), followed)
        except ValueError as error:
            raise setting_error(f"{key}: found {draw.record()}: {error}") from None
    return extremes


def draw_values(
    draws: Mapping[str, Draw],
    constants: Mapping[str, Any],
    limits: LimitsOf,
    seed_text: str,
    frame: float = 0,
) -> dict[str, Any]:
    """Return a value for each draw, by name.

    Args:
        draws: as for :func:`draw_order`.
        constants: as for :func:`draw_order`.
        limits: returns the limits of a value by its dotted name.
        seed_text: the text that seeds the draws, made of the seed and the image key.
        frame: the place of the frame in its sequence.

    Raises:
        KeyedError: as for :func:`draw_extremes`.
    """
    values = dict(constants)
    numbers = uniform_numbers(seed_text, draws)
    for key, draw in draws.items():
        if isinstance(draw, Drift):
            knots = draw.knots(frame)
            uniforms = uniform_numbers(seed_text, [f"{key}@{knot}" for knot in knots])
            numbers[key] = draw.between(frame, *uniforms.values())
    for key in draw_order(draws, constants):
        draw = draws[key]
        values[key] = draw.value(numbers[key], limits(key), values.get(draw.follows))
    return {key: values[key] for key in draws}


def uniform_numbers(seed_text: str, names: Iterable[str]) -> dict[str, float]:
    """Return a number above 0 and below 1 for each name, of 52 bits, by Philox keyed on the owner.

    >>> numbers = uniform_numbers("draw:0:a.exr", ["iso", "camera"])
    >>> {name: round(u, 3) for name, u in numbers.items()}
    {'iso': 0.282, 'camera': 0.608}
    """
    stream, numbers = stream_of(seed_text, ""), {}
    for name in names:
        high, low, *_ = philox_rounds(0, 0, 0, zlib.crc32(name.encode()), stream)
        numbers[name] = ((high << 20 | low >> 12) + 0.5) * 2.0**-52
    return numbers


def examples_of(drawn: Mapping[str, Sequence[Any]]) -> Iterator[dict[str, Any]]:
    """Yield each method with each extreme of each parameter, the others at their first extreme."""
    first = {name: values[0] for name, values in drawn.items()}
    methods = [{"method": method} for method in drawn.get("method", ())] or [{}]
    others = [{k: value} for k, values in drawn.items() if k != "method" for value in values]
    for method, other in product(methods, others or [{}]):
        yield {**first, **method, **other}
