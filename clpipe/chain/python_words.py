"""Messages in the words of Python: arguments instead of options of the command line."""

import re
from collections.abc import Iterator
from contextlib import contextmanager

from clpipe.base.errors import ClpipeError
from clpipe.base.interface import on_command_line
from clpipe.chain.keys import CODE, KEYS, Key
from clpipe.chain.options import OPTIONS
from clpipe.chain.registry import all_stages

KEY_BY_OPTION = {name.replace("_", "-"): key for name, key in (KEYS | OPTIONS).items()}
KEY_BY_OPTION["stage-file"] = KEYS[CODE]

# A command with its options stays as it is. The others are --set, -c, -o and further options.
PATTERNS = [
    r"clpipe [a-z]+(?: --[a-z-]+(?: [\w.]+)?)+",
    r"--set (?P<step>\w+)\.(?P<parameter>\w+)=(?P<setting>[^\s,;)]+\b)",
    r"-c (?P<config>(?!or\b|and\b)[\w-]+)",
    r"(?P<bare>-c\b(?! [\w-]*\.))",
    r"-o (?P<output>[\w./]+\w)",
    r"--(?P<option>[a-z][a-z-]*)(?:(?P<space>[ =])(?P<value>[\w./+-]*\w))?",
]
WORDS = re.compile("|".join(PATTERNS))


def python_words(text: str) -> str:
    """Return a message with arguments of Python in place of options of the command line.

    >>> python_words("add --transfer srgb, or use -c unprocess; --set denoise.radius=2")
    "add transfer='srgb', or use config='unprocess'; denoise={'radius': 2}"
    >>> python_words("--poses a.json: remove --frames (see clpipe run --sequence)")
    'poses a.json: remove frames (see clpipe run --sequence)'
    """
    return text if on_command_line() or "-" not in text else WORDS.sub(_python_word, text)


def _python_word(match: "re.Match[str]") -> str:
    """Return the words of Python for a match of :data:`WORDS`."""
    if match["step"]:
        setting = match["setting"]
        text = setting if re.fullmatch(r"[\d.e+-]+", setting) else repr(setting)
        return f"{match['step']}={{'{match['parameter']}': {text}}}"
    for name in ("config", "output"):
        if match[name]:
            return f"{name}={match[name]!r}"
    if match["bare"]:
        return "config"
    key = KEY_BY_OPTION.get(match["option"] or "")
    return match[0] if key is None else _argument(key, match["space"] or "", match["value"] or "")


def _argument(key: Key, space: str, word: str) -> str:
    """Return the argument for an option, and the word after it, which may be its value."""
    is_stage = (key.metavar or "").startswith("STAGE") and word in all_stages()
    if word in key.choices or is_stage or (key.name, word) == ("device", "numpy"):
        return f"{key.name}={word!r}"
    is_value = word == key.metavar or (key.type_ is int and word.isdecimal())
    return f"{key.name}={word}" if is_value else f"{key.name}{space}{word}"


@contextmanager
def errors_in_python() -> Iterator[None]:
    """Give errors of the ``with`` block, or of a decorated function, the words of Python.

    >>> from clpipe.base.errors import RequestError
    >>> with errors_in_python():
    ...     raise RequestError("add --webdataset N")
    Traceback (most recent call last):
    clpipe.base.errors.RequestError: add webdataset=N
    """
    try:
        yield
    except ClpipeError as error:
        message, *others = error.args or ("",)
        error.args = (python_words(str(message)), *others)
        raise
