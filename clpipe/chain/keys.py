"""TODO."""

from collections.abc import Mapping, Sequence
from typing import Any

from clpipe.base.errors import KeyedError

OUTPUT = "output"  # the table that is no stage's


MOST_ISO = 10**9


DRAWN = ("iso", "camera")  # what can be, beside parameters


KEYS = ("camera", "iso", "seed", "raw_size", "raw_type", "stages", "skip", "stage_files")


def check_type(key: str, value: Any) -> None:
    """See that a key that stands in no table has a value of its type.

    Raises:
        KeyedError: it has not.
    """
    types: dict[str, tuple[str, Any]] = {
        "iso": ("a number", int | float),
        "seed": ("a whole number", int),
        **dict.fromkeys(("camera", "raw_size", "raw_type"), ("text", str)),
    }
    kind, expected = types.get(key, ("", object))
    if not isinstance(value, expected) or isinstance(value, bool):
        raise KeyedError(key, f"{key}: found {value!r}, but it is {kind}")
    if key == "iso" and value > MOST_ISO:
        raise KeyedError(key, f"{key}: found {value!r}, but it is at most {MOST_ISO:g}")


def names_in(values: Mapping[str, Any], key: str, what: str) -> tuple[str, ...]:
    """The list of texts under a key; empty if it is not there.

    Raises:
        KeyedError: it is something else.
    """
    names = values.get(key, [])
    if isinstance(names, str | Mapping) or not isinstance(names, Sequence):
        raise KeyedError(key, f"{key}: found {names!r}, but it is a list of {what}")
    for name in names:
        if not isinstance(name, str):
            raise KeyedError(key, f"{key}: found {name!r} in the list, but it is one of {what}")
    return tuple(names)
