"""Command-line options for the keys of a configuration and of a run.

:mod:`clpipe.chain.keys` and :mod:`clpipe.chain.options` define the names, types, ranges and
choices. The docstring of :func:`clpipe.run` describes the options of a run.
"""

import math
import re
from collections.abc import Callable
from typing import Any

import click

from clpipe.base.errors import RequestError
from clpipe.base.memory import parse_size
from clpipe.base.text import whole_number
from clpipe.chain.assignments import parse_assignment
from clpipe.chain.formats import ALL_FORMATS, format_named
from clpipe.chain.keys import CODE, KEYS, Key, arguments_in
from clpipe.chain.options import OPTIONS
from clpipe.chain.request import Request
from clpipe.commands.completion import COMPLETIONS, parameters
from clpipe.commands.docstrings import docstring_of
from clpipe.commands.options import EXISTING, F, Option, output_option


class FormatName(click.Choice[str]):
    """The name of a format, or one of its aliases."""

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> str:
        return super().convert(format_named(value), param, ctx)


class Parsed(click.ParamType[Any]):
    """A value that a function parses. Its errors are not those of click."""

    def __init__(self, parse: Callable[[str], Any]) -> None:
        self.name = "text"
        self._parse = parse

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> Any:
        return self._parse(value) if isinstance(value, str) else value


def patch_count(text: str) -> int | str:
    """Return the number of patches per image, or "grid".

    Raises:
        RequestError: the text is neither.
    """
    key, count = OPTIONS["patches_per_image"], whole_number(text)
    if text != "grid" and not key.allows(count):
        raise RequestError(f"--patches-per-image: found {text!r}; expected {key.allowed}, or grid")
    return text if text == "grid" else count


ARGUMENTS = arguments_in(docstring_of("batch.api", "run"))


def described(key: Key) -> Key:
    """Return the key of an option with its text and default in the docstring of ``clpipe.run``.

    >>> described(OPTIONS["bit_rate"]).text
    'The mean bit rate of clips in bits per second, such as 8M, instead of --crf.'
    """
    entry = ARGUMENTS.get(key.name, "")  # without docstrings (python -OO), settings have no text
    words = re.sub(r"``(\w+)``", lambda match: f"--{match[1].replace('_', '-')}", entry)
    described, _, default = words.partition(" None is ")
    text, _, _ = described.partition(" The choices are ")
    return key._replace(text=text, default_text=default.removesuffix("."))


# Keys whose options are not called --name, and keys whose options have special types.
FLAGS = {"config": ("-c", "--config"), CODE: ("--stage-file",)}
TYPES: dict[str, Any] = {
    "stages": lambda text: [name.strip() for name in text.split(",") if name.strip()],
    "patches_per_image": Parsed(patch_count),
    "memory": Parsed(parse_size),
    "poses": EXISTING,
    CODE: EXISTING,
}


def option(key: Key, parameter: str = "", **others: Any) -> Callable[[F], F]:
    """Return a decorator that adds the option for a key to a command.

    Args:
        key: the key, which defines the option's type, range, choices and help.
        parameter: the parameter of the command's function, if it is not the key's name.
        **others: arguments of :func:`click.option` that replace those from the key.
    """
    key = key if key.text else described(key)
    type_: Any = {int: int, float: float}.get(key.type_)
    if key.choices:
        choice = FormatName if key.name == "format" else click.Choice
        type_ = choice(key.choices, case_sensitive=False)
    elif key.type_ is int and key.above > -math.inf:
        type_ = click.IntRange(int(key.above) + 1, None if key.most == math.inf else int(key.most))
    multiple = key.type_ is list and key.name != "stages"
    texts = [key.text, f"In {key.unit}." * bool(key.unit), "May be repeated." * multiple]
    attributes: dict[str, Any] = {
        "cls": Option,
        "heading": key.heading,
        "type": TYPES.get(key.name, type_),
        "metavar": key.metavar,
        "multiple": multiple,
        "shell_complete": COMPLETIONS.get(key.name) or COMPLETIONS.get(key.metavar or ""),
        "help": " ".join(
            filter(None, [*texts, f"[default: {key.default_text}]" * bool(key.default_text)])
        ),
    }
    if key.type_ is bool:
        attributes["is_flag"] = True
    flags = FLAGS.get(key.name, (f"--{key.name.replace('_', '-')}",))
    return click.option(*flags, parameter or key.name, **{**attributes, **others})


def options(*keys: Key | str) -> Callable[[F], F]:
    """Return a decorator that adds the options for keys to a command.

    Args:
        *keys: keys, or names of keys in :data:`OPTIONS`.
    """

    def decorate(function: F) -> F:
        for key in reversed(keys):
            function = option(OPTIONS[key] if isinstance(key, str) else key)(function)
        return function

    return decorate


set_option = click.option(
    "--set",
    "assignments",
    cls=Option,
    heading="+Chain",
    multiple=True,
    metavar="STAGE.PARAM=VALUE",
    shell_complete=parameters,
    help="Set a parameter. STAGE.method=NAME chooses a method. A value such as '{uniform=[1, 2]}' "
    "is drawn for each image. May be repeated.",
)
out_option = output_option("OUT", described(OPTIONS["output"]).text)
DEVICE = described(OPTIONS["device"])._replace(type_=str)
device_option = option(DEVICE._replace(default_text="the first GPU, else the CPU"), "selector")
FORMAT = described(OPTIONS["format"])._replace(choices=ALL_FORMATS)
# A sentence about clips follows, which only clpipe run writes.
format_option = option(FORMAT._replace(text=FORMAT.text.partition(" mp4 and")[0]), "formats")

# Settings with an option, in addition to the camera and the ISO.
SETTINGS = tuple(key for name, key in KEYS.items() if name not in ("camera", "iso", "dump", CODE))


def chain_options(function: F) -> F:
    """Add the options that choose a chain, which :func:`request_of` converts to a request."""
    chosen = options("config", KEYS["camera"], KEYS["iso"], *SETTINGS, "start_at", "until", CODE)
    return chosen(set_option(function))


def settings_in(options: dict[str, Any]) -> dict[str, Any]:
    """Remove the settings from a command's options, and return them nested like a configuration.

    Raises:
        RequestError: an assignment is wrong, or sets a value that an option also sets.
    """
    chosen = {key: options.pop(key) for key in KEYS if key in options and key != CODE}
    settings = {key: value for key, value in chosen.items() if value not in (None, ())}
    assigned: dict[str, dict[str, Any]] = {}
    for text in options.pop("assignments", ()):
        stage, parameter, value = parse_assignment(text)
        if stage in settings:
            raise RequestError(f"--set {text}: found --{stage} as well; use only one of them")
        assigned.setdefault(stage, {})[parameter] = value
    return {**settings, **assigned}


def request_of(options: dict[str, Any]) -> Request:
    """Return the request for a command's options, which must all be keys of a request.

    Raises:
        RequestError: a name or value is not allowed.
    """
    return Request.from_options(values=settings_in(options), **options)
