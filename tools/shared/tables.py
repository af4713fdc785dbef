"""Tables in Markdown, and the columns of noise in them."""

from collections.abc import Iterable, Mapping, Sequence

# The columns of a signature in tables: heading, attribute, format.
COLUMNS = (
    ("rms", "rms", ".1f"),
    ("kurtosis", "kurtosis", ".1f"),
    ("beyond 4 sigma, 1e-4", "beyond_4_sigma", ".0f"),
    ("right", "right", ".2f"),
    ("below", "below", ".2f"),
    ("diagonal", "diagonal", ".2f"),
    ("2 right", "two_right", ".2f"),
    ("half", "half", ".2f"),
    ("chroma right", "chroma_right", ".2f"),
    ("R-G", "red_green", ".2f"),
)


def cells(record: Mapping[str, float]) -> list[str]:
    """Format the columns of a signature."""
    return [format(record[name], form) if name in record else "" for _, name, form in COLUMNS]


def markdown(heads: Sequence[str], rows: Iterable[Iterable[object]]) -> str:
    """Format a table. Bars in cells are escaped.

    >>> print(markdown(["a", "b"], [["1", 2]]))
    | a | b |
    |---|---|
    | 1 | 2 |
    """
    lines = [[str(cell).replace("|", "\\|") for cell in row] for row in (heads, *rows)]
    first, *others = (f"| {' | '.join(line)} |" for line in lines)
    return "\n".join([first, "|---" * len(heads) + "|", *others])
