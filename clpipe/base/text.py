"""Text for messages: suggestions for misspelt names, and escaping of unprintable characters."""

import re
from collections.abc import Iterable, Sequence
from difflib import get_close_matches
from pathlib import Path

MIN_WORD_LENGTH = 4  # the fewest letters of a word that can match a misspelt name


def similar_names(text: str, names: Iterable[str], cutoff: float = 0.55) -> list[str]:
    """Return the names that a shortened or misspelt name may mean, in their order.

    These are the names that contain all of its words. If there are none, the function returns the
    most similar name, or the names that contain the most similar word.

    Args:
        text: the name as the user wrote it.
        names: the existing names.
        cutoff: the least similarity, from 0 to 1.

    >>> similar_names("canon 5d", ["canon-5d2", "canon-6d", "canon-5d3"])
    ['canon-5d2', 'canon-5d3']
    >>> similar_names("Demosiac", ["mosaic", "demosaic"])
    ['demosaic']
    >>> similar_names("noize", ["normalize", "row_noise", "column_noise"])
    ['row_noise', 'column_noise']
    """
    by_lower = {name.lower(): name for name in names}
    similar = names_with_words(text, by_lower)
    if not similar:
        words = {word for name in by_lower for word in _words(name) if len(word) >= MIN_WORD_LENGTH}
        best = get_close_matches(text.lower(), [*by_lower, *sorted(words)], 1, cutoff)
        similar = (
            best if best and best[0] in by_lower else names_with_words("".join(best), by_lower)
        )
    return [by_lower[name] for name in similar]


def names_with_words(text: str, names: Iterable[str]) -> list[str]:
    """Return the names that contain all words of a text, in their order.

    >>> names_with_words("noise", ["sensor_noise", "denoise", "row_noise"])
    ['sensor_noise', 'row_noise']
    """
    words = _words(text)
    return [name for name in names if words and words <= _words(name)]


def _words(text: str) -> set[str]:
    return set(re.findall(r"[^\W\d_]+|\d+", text.lower()))


def quote_alternatives(names: Iterable[str]) -> str:
    """Return names as alternatives, in quotes.

    >>> quote_alternatives(["a", "b", "c"])
    "'a', 'b' or 'c'"
    """
    *others, last = (f"'{name}'" for name in names)
    return f"{', '.join(others)} or {last}" if others else last


def unknown_name(what: str, found: str, allowed: Iterable[str], nearest: str | None = None) -> str:
    """Return a message about an unknown name, with a suggestion.

    Args:
        what: the kind of thing that the name means, such as "stage".
        found: the unknown name.
        allowed: the existing names.
        nearest: the name to suggest. None suggests the most similar of the allowed names.

    >>> unknown_name("stage", "demosiac", ["mosaic", "demosaic"])
    "unknown stage 'demosiac' (did you mean 'demosaic'?); allowed: mosaic, demosaic"
    """
    names = list(map(one_line, allowed))
    similar = [nearest] if nearest else similar_names(found, names)
    hint = f" (did you mean {quote_alternatives(similar)}?)" if similar else ""
    return f"unknown {what} '{one_line(found)}'{hint}; allowed: {', '.join(names) or 'none'}"


def one_line(text: str) -> str:
    r"""Return a text in one line, with escapes for unprintable characters.

    File names may contain such characters, which would break lines or change the terminal's state.

    >>> one_line("in/a" + chr(10) + chr(27) + "[31m.exr")
    'in/a\\n\\x1b[31m.exr'
    """
    if text.isprintable():  # nearly all texts are printable
        return text
    return "".join(c if c.isprintable() else c.encode("unicode_escape").decode() for c in text)


def printable(text: str) -> str:
    """Return a text in one line, with a question mark for each unprintable character.

    >>> printable("R" + chr(1) + chr(10) + "G")
    'R? G'
    """
    line = " ".join(text.split())
    return "".join(letter if letter.isprintable() else "?" for letter in line)


MAX_DIGITS = 18  # digits of a whole number; int() raises ValueError for more than 4300


def whole_number(text: str) -> int:
    """Return the whole number of a text of decimal digits.

    Returns:
        The number; -1 if the text has other characters, no digits, or more than 18 digits.

    >>> whole_number("42"), whole_number("-3"), whole_number("9" * 5000)
    (42, -1, -1)
    """
    return int(text) if text.isdecimal() and len(text) <= MAX_DIGITS else -1


def format_duration(seconds: float) -> str:
    """Return a length of time as text.

    >>> format_duration(5.21), format_duration(83), format_duration(7265)
    ('5.2 s', '1 min 23 s', '2 h 01 min')
    """
    if seconds < 60:
        return f"{seconds:.1f} s"
    minutes, rest = divmod(round(seconds), 60)
    if minutes < 60:
        return f"{minutes} min {rest:02} s"
    return f"{minutes // 60} h {minutes % 60:02} min"


def as_texts(values: str | int | Path | Sequence[str | int | Path] | None) -> tuple[str, ...]:
    """Return one value or several as a tuple of texts; an empty tuple for None.

    >>> as_texts("a"), as_texts((0, Path("b"))), as_texts(None)
    (('a',), ('0', 'b'), ())
    """
    return tuple(map(str, [values] if isinstance(values, str | int | Path) else values or ()))
