"""Random draws in place of values: their order, their extremes, and the values of an image.

The distributions are in :mod:`clpipe.chain.draws`.
"""

import zlib
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any

from clpipe.base.errors import KeyedError
from clpipe.base.text import one_of
from clpipe.chain.draws import Choice, Draw, Limits, parse_draw
from clpipe.chain.keys import KEYS
from clpipe.reference.random import philox_rounds, stream_of

LimitsOf = Callable[[str], Limits | None]  # by the dotted name of a value


def draw_of(key: str, table: Mapping[str, Any]) -> Draw:
    """Return the draw that a table declares in place of a value.

    Raises:
        KeyedError: the table is no draw, or the value cannot be drawn from it.
    """
    if key in KEYS and not KEYS[key].is_drawn:
        drawn = ", ".join(known.name for known in KEYS.values() if known.is_drawn)
        allowed = f"{drawn} and the parameters of stages can be"
        raise KeyedError(
            key, f"{key}: found {dict(table)!r}, but {key} cannot be drawn; only {allowed}"
        )
    draw = parse_draw(key, table)
    if (key == "camera" or key.endswith(".method")) and not isinstance(draw, Choice):
        raise KeyedError(
            key,
            f"{key}: found {dict(table)!r}, but a name can only be drawn by choice; "
            "use {choice = ['A', 'B']}",
        )
    return draw


def ordered(draws: Mapping[str, Draw], constants: Mapping[str, Any]) -> list[str]:
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
                raise KeyedError(
                    key,
                    f"{key}: the draw follows itself: {' -> '.join(path)}; "
                    "set one of these to a value",
                )
        if leader and leader not in constants:
            names = sorted({*constants, *draws} - {path[-1]})
            unknown = one_of("value", leader, names).replace("allowed", "set or drawn are")
            raise KeyedError(path[-1], f"{path[-1]}: {unknown}")
        return len(path)

    return sorted(draws, key=depth)


def extremes_of(
    draws: Mapping[str, Draw], constants: Mapping[str, Any], limits: LimitsOf
) -> dict[str, Sequence[Any]]:
    """Return the extreme values of each draw. If they are allowed, every drawn value is.

    Args:
        draws: as for :func:`ordered`.
        constants: as for :func:`ordered`.
        limits: returns the limits of a value by its dotted name.

    Raises:
        KeyedError: a draw does not fit its limits or the value that it follows, or as for
            :func:`ordered`.
    """
    extremes: dict[str, Sequence[Any]] = {}
    for key in ordered(draws, constants):
        draw, leader = draws[key], draws[key].follows
        followed: Sequence[Any] = []
        if leader:
            followed = extremes[leader] if leader in extremes else [constants[leader]]
        try:
            extremes[key] = draw.extremes(limits(key), followed)
        except ValueError as error:
            raise KeyedError(key, f"{key}: found {draw.record()}: {error}") from None
    return extremes


def values_of(
    draws: Mapping[str, Draw], constants: Mapping[str, Any], limits: LimitsOf, owner: str
) -> dict[str, Any]:
    """Return a value for each draw, by name. Arguments and errors are those of :func:`extremes_of`.

    ``owner`` seeds the draws; it is a text made of the seed and the image key.
    """
    values = dict(constants)
    numbers = uniforms(owner, draws)
    for key in ordered(draws, constants):
        draw = draws[key]
        values[key] = draw.value(numbers[key], limits(key), values.get(draw.follows))
    return {key: values[key] for key in draws}


def uniforms(owner: str, names: Iterable[str]) -> dict[str, float]:
    """Return a number above 0 and below 1 for each name, of 52 bits, by Philox keyed on the owner.

    >>> {name: round(u, 3) for name, u in uniforms("draw:0:a.exr", ["iso", "camera"]).items()}
    {'iso': 0.282, 'camera': 0.608}
    """
    stream, numbers = stream_of(owner, ""), {}
    for name in names:
        high, low, *_ = philox_rounds(0, 0, 0, zlib.crc32(name.encode()), stream)
        numbers[name] = ((high << 20 | low >> 12) + 0.5) * 2.0**-52
    return numbers
