"""Text for messages: suggestions for misspelt names, and text that is safe to print."""

from collections.abc import Iterable, Sequence
from difflib import get_close_matches
from pathlib import Path


def one_of(what: str, found: str, allowed: Iterable[str], nearest: str | None = None) -> str:
    """A message for an unknown name, with a suggestion.

    Args:
        what: the name is of.
        found: the name.
        allowed: the names that there are.
        nearest: the name to suggest; None is the most similar of those that are allowed.

    >>> one_of("stage", "demosiac", ["mosaic", "demosaic"])
    "unknown stage 'demosiac' (did you mean 'demosaic'?); allowed: mosaic, demosaic"
    """
    names = list(map(one_line, allowed))
    near = [nearest] if nearest else get_close_matches(found, names, n=1, cutoff=0.5)
    hint = f" (did you mean '{near[0]}'?)" if near else ""
    return f"unknown {what} '{one_line(found)}'{hint}; allowed: {', '.join(names) or 'none'}"


def one_line(text: str) -> str:
    r"""The text in one line, with an escape for each character that cannot be printed.

    A file's name may hold such characters; they would break a line, or change the terminal.

    >>> one_line("in/a" + chr(10) + chr(27) + "[31m.exr")
    'in/a\\n\\x1b[31m.exr'
    """
    if text.isprintable():  # as nearly all are
        return text
    return "".join(c if c.isprintable() else c.encode("unicode_escape").decode() for c in text)


def printable(text: str) -> str:
    """The text in one line, with ? for each character that cannot be printed.

    >>> printable("R" + chr(1) + chr(10) + "G")
    'R? G'
    """
    line = " ".join(text.split())
    return "".join(letter if letter.isprintable() else "?" for letter in line)


MOST_DIGITS = 18  # of a whole number; int() raises ValueError for more than 4300


def whole_number(text: str) -> int:
    """Returns the whole number that a text of decimal digits stands for.

    Returns -1 if the text has other characters, no digits, or more than 18 digits.

    >>> whole_number("42"), whole_number("-3"), whole_number("9" * 5000)
    (42, -1, -1)
    """
    return int(text) if text.isdecimal() and len(text) <= MOST_DIGITS else -1


def duration(seconds: float) -> str:
    """A length of time for people.

    >>> duration(5.21), duration(83), duration(7265)
    ('5.2 s', '1 min 23 s', '2 h 01 min')
    """
    if seconds < 60:
        return f"{seconds:.1f} s"
    minutes, rest = divmod(round(seconds), 60)
    if minutes < 60:
        return f"{minutes} min {rest:02} s"
    return f"{minutes // 60} h {minutes % 60:02} min"


def several(values: str | int | Path | Sequence[str | int | Path]) -> tuple[str, ...]:
    """One value or several as texts.

    >>> several("a"), several((0, Path("b")))
    (('a',), ('0', 'b'))
    """
    return tuple(map(str, [values] if isinstance(values, str | int | Path) else values))
