"""The keys of a configuration: values that a user may set by name, with type, range and help.

The options of a run have the same form, see :mod:`clpipe.chain.options`.
"""

import math
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

from clpipe.base.errors import KeyedError
from clpipe.camera.profile import DEFAULT_CAMERA
from clpipe.images.dump import TYPES

CODE = "stage_files"  # the key that only a configuration file may have

# Names of tables that do not belong to a stage.
OUTPUT, RENDER, CONTROL = "output", "render", "control"
TABLES = (OUTPUT, RENDER, CONTROL)

NOISE = "noise"  # an item of "skip": the noise of every stage

MAX_STAGES = 256  # stages per chain; limited because other people's files may contain a chain
DEFAULT_ISO = 100.0

WORDS = {float: "a number", int: "a whole number", str: "text", bool: "true or false"}


class Key(NamedTuple):
    """A value that a user may set by name: a key of a configuration, or an option of a run.

    Args:
        name: its name in configurations and in Python. A command has the option ``--name``.
        type_: the type of the value. :class:`list` is a list of texts.
        text: sentences for help and documentation. Brief help shows the start of the first one. ""
            is the text in the docstring of :func:`clpipe.run`.
        metavar: what the help of a command writes in place of the value.
        default_text: the default in words; "" if there is none.
        choices: the texts that are allowed; () is any text.
        unit: the unit of the value.
        above: the value must be larger than this number.
        most: the largest number that is allowed.
        is_drawn: whether a draw is allowed in place of the value.
    """

    name: str
    type_: type
    text: str = ""
    metavar: str | None = None
    default_text: str = ""
    choices: Sequence[str] = ()
    unit: str = ""
    above: float = -math.inf
    most: float = math.inf
    is_drawn: bool = False

    @property
    def allowed(self) -> str:
        """The type and the range in words.

        >>> Key("jobs", int, "", above=0, most=8).allowed, Key("iso", float, "", most=900).allowed
        ('a whole number from 1 to 8', 'a number up to 900')
        """
        is_counted = self.type_ is int and self.above > -math.inf
        least = f" from {self.above + 1:g}" if is_counted else f" above {self.above:g}"
        most = f"{'' if is_counted else ' up'} to {self.most}"
        return WORDS[self.type_] + least * (self.above > -math.inf) + most * (self.most < math.inf)

    def allows(self, value: Any) -> bool:
        """Return whether a value has the type and is in the range.

        Lists and choices are not checked.
        """
        if self.type_ is list:
            return True
        types: Any = (int, float) if self.type_ is float else self.type_
        if not isinstance(value, types) or isinstance(value, bool) is not (self.type_ is bool):
            return False
        return isinstance(value, str) or self.above < value <= self.most


def _lens_key(name: str, text: str, unit: str = "") -> Key:
    """Return the key of a lens setting."""
    return Key(name, float, text, unit=unit, above=0, most=10**6, is_drawn=True)


_ALL = (
    Key(
        "camera",
        str,
        "A built-in camera, by name or model, or a profile (.toml).",
        "NAME|FILE",
        DEFAULT_CAMERA,
        is_drawn=True,
    ),
    Key(
        "iso",
        float,
        "The ISO. Noise and denoising depend on it.",
        default_text=f"{DEFAULT_ISO:g}",
        most=10**9,
        is_drawn=True,
    ),
    Key(
        "lens",
        str,
        "A lens in lensfun's database, with its distortion, lateral colour and vignetting; or "
        "'typical', whose faults are drawn for each image; or 'none', without any blur.",
        "NAME",
        "a good lens without distortion",
        is_drawn=True,
    ),
    _lens_key("focal_length", "The focal length of the lens.", "mm"),
    _lens_key(
        "aperture",
        "The f-number of the lens. Without it, a lens from lensfun's database has no vignetting.",
    ),
    _lens_key(
        "focus_distance",
        "The distance to the plane in focus. By default, vignetting is that at infinity, and "
        "the stage defocus uses 3.",
        "m",
    ),
    Key("seed", int, "The seed of the noise.", default_text="0"),
    Key(
        "noise_key",
        str,
        "Images with the same key have the same noise, at any ISO. Without a key, each image and "
        "ISO has its own noise.",
        "TEXT",
    ),
    Key(
        "dump",
        str,
        "The width, height and sample type of headerless dumps (.raw), such as "
        f"1920x1080:uint16le. The types are {', '.join(TYPES)}.",
        "WxH:TYPE",
    ),
    Key("stages", list, "The stages to run, in order, in place of the default chain.", "A,B,C"),
    Key(
        "skip",
        list,
        f"A stage to skip, or '{NOISE}'. This skips the noise of all stages; denoising stays as "
        "strong as the ISO requires.",
        "STAGE",
    ),
    Key(CODE, list, "A Python file that defines further stages.", "FILE.py"),
)
KEYS = {key.name: key for key in _ALL}

# The settings that select a lens and set it.
LENS = ("lens", "focal_length", "aperture", "focus_distance")


def setting_error(message: str) -> KeyedError:
    """Return the error about a setting, for a message that begins with its dotted name.

    >>> setting_error("iso: found 'fast', but expected a number").key
    'iso'
    """
    return KeyedError(message.partition(":")[0], message)


def check_type(key: str, value: Any) -> None:
    """Check that the value of a key has the key's type and is in its range.

    Raises:
        KeyedError: it is not.
    """
    if (known := KEYS.get(key)) and not known.allows(value):
        hint = ""
        if known.is_drawn and isinstance(value, list | tuple):
            is_range = known.type_ is float and len(value) == 2
            draw = {"log_uniform" if is_range else "choice": list(value)}
            hint = f"; to draw it for each image, use {key}={draw}"
        raise setting_error(f"{key}: found {value!r}, but expected {known.allowed}{hint}")


def set_dotted(values: dict[str, Any], key: str, value: Any) -> None:
    """Set a value in nested ones, by a key such as ``iso`` or ``stage.parameter``.

    >>> nested = {"iso": 100}
    >>> set_dotted(nested, "gamma.exponent", 2.0)
    >>> nested
    {'iso': 100, 'gamma': {'exponent': 2.0}}
    """
    table, _, name = key.rpartition(".")
    (values.setdefault(table, {}) if table else values)[name] = value


def string_list(values: Mapping[str, Any], key: str, what: str) -> tuple[str, ...]:
    """Return the list of texts under a key; empty if the key is missing.

    Args:
        values: nested values, as in a TOML file.
        key: a key whose value is a list of texts. For "skip", a single text is allowed.
        what: a description of the texts, for the message.

    Raises:
        KeyedError: the value is no list, or an item is no text.
    """
    names = values.get(key, [])
    if key == "skip" and isinstance(names, str):
        return (names,)
    if isinstance(names, str | Mapping) or not isinstance(names, Sequence):
        raise setting_error(f"{key}: found {names!r}, but expected a list of {what}")
    for name in names:
        if not isinstance(name, str):
            raise setting_error(f"{key}: found {name!r} in the list, but expected only {what}")
    return tuple(names)
