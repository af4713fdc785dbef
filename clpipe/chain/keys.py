"""The keys of a configuration that stand in no table, and the types of their values."""

import math
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

from clpipe.base.errors import KeyedError

CODE = "stage_files"  # the key that only a configuration file may have

OUTPUT, RENDER = "output", "render"  # the tables that belong to no stage
TABLES = (OUTPUT, RENDER)

NOISE = "noise"  # under "skip": the noise of every stage

MAX_STAGES = 256  # of a chain; an image can carry one


class Key(NamedTuple):
    """A key of a configuration.

    Args:
        name: the key.
        type_: of its value, :class:`list` for a list of texts.
        is_drawn: whether a draw may stand in place of its value.
        text: one sentence about it, for help.
        unit: of its value.
        most: the largest number that it may be.
        above: what a number must be larger than; None is any.
    """

    name: str
    type_: type
    is_drawn: bool = False
    text: str = ""
    unit: str = ""
    most: float = math.inf
    above: float | None = None


def _of_lens(name: str, text: str, unit: str = "") -> Key:
    """What a lens is set to."""
    return Key(name, float, is_drawn=True, text=text, unit=unit, most=1e6, above=0.0)


LENS_TEXT = "A lens of lensfun's database: its distortion, lateral colour and vignetting."
NOISE_KEY_TEXT = (
    "Share the noise with all images that have this key, whatever their ISO; without it, each "
    "image and ISO has noise of its own."
)
_ALL = (
    Key("camera", str, is_drawn=True),
    Key("iso", float, is_drawn=True, most=1e9),
    Key("lens", str, is_drawn=True, text=LENS_TEXT),
    _of_lens("focal_length", "The lens's focal length.", "mm"),
    _of_lens("aperture", "The lens's f-number; without it, a lens by name does not vignette."),
    _of_lens("focus_distance", "Where the lens is focused; without it, far away.", "m"),
    Key("seed", int, text="The seed of the noise."),
    Key("noise_key", str, text=NOISE_KEY_TEXT),
    Key("dump", str),
    Key("stages", list),
    Key("skip", list),
    Key(CODE, list),
)
KEYS = {key.name: key for key in _ALL}

LENS = ("lens", "focal_length", "aperture", "focus_distance")  # how a lens is named and set


def check_type(key: str, value: Any) -> None:
    """See that the value of a key is of the key's type, and in its range.

    Raises:
        KeyedError: it is not.
    """
    known = KEYS.get(key)
    if not known or known.type_ is list:
        return
    kind = {float: "a number", int: "a whole number", str: "text"}[known.type_]
    types: Any = (int, float) if known.type_ is float else known.type_
    if not isinstance(value, types) or isinstance(value, bool):
        raise KeyedError(key, f"{key}: found {value!r}, but it is {kind}")
    if known.above is not None and not known.above < value < known.most:
        allowed = f"above {known.above:g} and below {known.most:g}"
        raise KeyedError(key, f"{key}: found {value!r}, but it is {allowed}")
    if known.type_ is float and value > known.most:
        raise KeyedError(key, f"{key}: found {value!r}, but it is at most {known.most:g}")


def names_in(values: Mapping[str, Any], key: str, what: str) -> tuple[str, ...]:
    """The list of texts under a key; empty where the key is missing.

    Args:
        values: nested values, as a TOML file holds them.
        key: one whose value is a list of texts; to skip one stage, a text will do.
        what: what the texts are, for the message.

    Raises:
        KeyedError: the value is no list, or an item is no text.
    """
    names = values.get(key, [])
    if key == "skip" and isinstance(names, str):
        return (names,)
    if isinstance(names, str | Mapping) or not isinstance(names, Sequence):
        raise KeyedError(key, f"{key}: found {names!r}, but it is a list of {what}")
    for name in names:
        if not isinstance(name, str):
            raise KeyedError(key, f"{key}: found {name!r} in the list, but it is one of {what}")
    return tuple(names)
