"""The keys of a configuration that stand in no table, and the types of their values."""

from collections.abc import Mapping, Sequence
from typing import Any

from clpipe.base.errors import KeyedError

CODE = "stage_files"  # the key that only a configuration file may have

LENS = ("lens", "focal_length", "aperture", "focus_distance")  # how a lens is named and set

KEYS = (
    *("camera", "iso", *LENS, "seed", "noise_key", "dump", "stages", "skip"),
    CODE,
)

OUTPUT, RENDER = "output", "render"  # the tables that belong to no stage
TABLES = (OUTPUT, RENDER)

DRAWABLE = (
    "iso",
    "camera",
    *LENS,
)  # of the keys; parameters of stages and of other tables can be, too

MAX_ISO = 10**9

MAX_LENGTH = 10**6  # of what a lens is set to, in mm or m

NOISE = "noise"  # under "skip": the noise of every stage

MAX_STAGES = 256  # of a chain; an image can carry one

TYPES: dict[str, tuple[str, Any]] = {
    "iso": ("a number", int | float),
    "seed": ("a whole number", int),
    **dict.fromkeys(LENS[1:], ("a number", int | float)),
    **dict.fromkeys(("camera", "lens", "noise_key", "dump"), ("text", str)),
}

# What a value is, for people, and its unit.
ABOUT: dict[str, tuple[str, str]] = {
    "lens": (
        "A lens of lensfun's database: its distortion, lateral colour and vignetting.",
        "",
    ),
    "focal_length": ("The lens's focal length.", "mm"),
    "aperture": ("The lens's f-number; without it, a lens by name does not vignette.", ""),
    "focus_distance": ("Where the lens is focused; without it, far away.", "m"),
    "seed": ("The seed of the noise.", ""),
    "noise_key": (
        "Share the noise with all images that have this key, whatever their ISO; without it, each "
        "image and ISO has noise of its own.",
        "",
    ),
}


def check_type(key: str, value: Any) -> None:
    """See that the value of a key is of the key's type.

    Raises:
        KeyedError: it is not, or is an ISO above :data:`MAX_ISO`.
    """
    kind, expected = TYPES.get(key, ("", object))
    if not isinstance(value, expected) or isinstance(value, bool):
        raise KeyedError(key, f"{key}: found {value!r}, but it is {kind}")
    if key in LENS[1:] and not 0 < value < MAX_LENGTH:
        raise KeyedError(key, f"{key}: found {value!r}, but it is above 0 and below {MAX_LENGTH:g}")
    if key == "iso" and value > MAX_ISO:
        raise KeyedError(key, f"{key}: found {value!r}, but it is at most {MAX_ISO:g}")


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
