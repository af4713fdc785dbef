"""Parse assignments of the form ``stage.parameter=value``, for --set."""

import re
from typing import Any

from clpipe.base.errors import RequestError
from clpipe.base.text import quote_alternatives, similar_names
from clpipe.chain.keys import CODE, KEYS
from clpipe.chain.methods import parameter_names
from clpipe.chain.registry import all_stages
from clpipe.chain.toml import toml_value


def parse_assignment(text: str) -> tuple[str, str, Any]:
    """Return the three parts of ``stage.parameter=value``.

    The value is converted by :func:`clpipe.chain.toml.toml_value`.

    >>> parse_assignment("sensor_noise.a = 1e-4")
    ('sensor_noise', 'a', 0.0001)

    Raises:
        RequestError: the text does not have that form. The message suggests a correct one.
    """
    match = re.fullmatch(r"\s*(\w+)\.(\w+)\s*=\s*(.*)", text)
    if not match or (match[1] in KEYS and match[2] in KEYS):  # "iso.uniform" is a draw
        raise RequestError(f"--set {text}: expected stage.parameter=value{_suggestion(text)}")
    return match[1], match[2], toml_value(match[3])


def _suggestion(text: str) -> str:
    """Return what the user probably meant, as the end of a message.

    >>> _suggestion("iso=800"), _suggestion("denoise=mean")
    ('; use --iso 800', "; did you mean 'denoise.method=mean'?")
    >>> _suggestion("denoise=2")
    "; 'clpipe stages denoise' lists the parameters of this stage"
    >>> _suggestion("iso={choice=[100,800]}")
    '; to draw it, write iso = {choice=[100,800]} in a configuration and use -c'
    >>> _suggestion("luma_strenght=2")
    "; did you mean 'denoise.luma_strength=2'?"
    """
    name, equals, value = map(str.strip, text.partition("="))
    stage, _, parameter = name.partition(".")
    name = parameter if stage in KEYS and parameter in KEYS else name
    if name in KEYS and name != CODE:
        if value.startswith("{"):
            return f"; to draw it, write {name} = {value} in a configuration and use -c"
        return f"; use --{name.replace('_', '-')} {value or 'VALUE'}"
    if name in all_stages():
        if all(each.method != value for each in all_stages()[name].methods):
            return f"; 'clpipe stages {name}' lists the parameters of this stage"
        meant = [f"{name}.method"]
    else:
        known = parameter_names()
        meant = [key for key in known if key.endswith(f".{name}")]
        if not meant:
            parameters = {key.partition(".")[2]: key for key in reversed(known)}
            meant = [parameters[each] for each in similar_names(name, parameters, cutoff=0.7)]
    if not equals or not meant:
        return "; 'clpipe stages' lists the stages, and 'clpipe stages NAME' the parameters of one"
    return f"; did you mean {quote_alternatives(f'{key}={value}' for key in meant)}?"
