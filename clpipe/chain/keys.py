"""The keys of a configuration: values that a user may set by name, with type, range and help.

The options of a run have the same form, see :mod:`clpipe.chain.options`.
"""

import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from inspect import cleandoc
from typing import Any, NamedTuple

from clpipe.base.errors import KeyedError
from clpipe.camera.profile import DEFAULT_CAMERA
from clpipe.stages import DEFAULT_CHAIN

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
        heading: the heading in the help of a command; "+" marks what brief help also shows.
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
    heading: str = ""

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


@dataclass(frozen=True)
class PlainSettings:
    """The settings outside tables. None and "" are automatic.

    The focal length is in mm, the distance in m. The help of commands has these descriptions.

    Args:
        camera: a built-in camera, by name or model, or a profile (.toml).
        iso: the ISO. Noise and denoising depend on it.
        lens: a lens in lensfun's database, with its distortion, lateral colour and vignetting; or
            'typical', whose faults are drawn for each image; or 'none', without any blur.
        focal_length: the focal length of the lens.
        aperture: the f-number of the lens. Without it, a lens from lensfun's database has no
            vignetting.
        focus_distance: the distance to the plane in focus. By default, vignetting is that at
            infinity, and the stage defocus uses 3.
        seed: the seed of the noise.
        noise_key: images with the same key have the same noise, at any ISO. Without a key, each
            image and ISO has its own noise.
        dump: the width, height and sample type of headerless dumps (.raw), such as
            1920x1080:uint16le. The types are uint8, uint16le, uint16be, raw10, raw12.
        stages: the stages to run, in order, in place of the default chain.
        skip: a stage to skip, or 'noise'. This skips the noise of all stages; denoising stays as
            strong as the ISO requires.
    """

    camera: str = DEFAULT_CAMERA
    iso: float = DEFAULT_ISO
    lens: str = ""
    focal_length: float | None = None
    aperture: float | None = None
    focus_distance: float | None = None
    seed: int = 0
    noise_key: str = ""
    dump: str = ""
    stages: tuple[str, ...] = DEFAULT_CHAIN
    skip: tuple[str, ...] = ()


def arguments_in(docstring: str) -> dict[str, str]:
    """Return the descriptions of the arguments in a docstring, as sentences in one line.

    >>> arguments_in(PlainSettings.__doc__ or "")["seed"]
    'The seed of the noise.'
    """
    entries = re.findall(r"^ {4}(\w+): (.+(?:\n {8}.+)*)", cleandoc(docstring), re.M)
    return {name: " ".join(f"{text[0].upper()}{text[1:]}".split()) for name, text in entries}


_ALL = (
    Key("camera", str, "", "NAME|FILE", DEFAULT_CAMERA, is_drawn=True, heading="+Camera"),
    Key(
        "iso", float, default_text=f"{DEFAULT_ISO:g}", most=10**9, is_drawn=True, heading="+Camera"
    ),
    Key(
        "lens", str, "", "NAME", "a good lens without distortion", is_drawn=True, heading="+Camera"
    ),
    Key("focal_length", float, unit="mm", above=0, most=10**6, is_drawn=True, heading="Camera"),
    Key("aperture", float, above=0, most=10**6, is_drawn=True, heading="Camera"),
    Key("focus_distance", float, unit="m", above=0, most=10**6, is_drawn=True, heading="Camera"),
    Key("seed", int, default_text="0", heading="+Camera"),
    Key("noise_key", str, metavar="TEXT", heading="Camera"),
    Key("dump", str, metavar="WxH:TYPE", heading="Inputs"),
    Key("stages", list, metavar="A,B,C", heading="Chain"),
    Key("skip", list, metavar="STAGE", heading="+Chain"),
    Key(CODE, list, metavar="FILE.py", heading="Chain"),
)
_TEXTS = arguments_in(PlainSettings.__doc__ or "")
KEYS = {key.name: key._replace(text=_TEXTS.get(key.name, "")) for key in _ALL}

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
