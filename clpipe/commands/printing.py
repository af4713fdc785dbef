"""Prints tables, numbers and JSON on stdout."""

import json
import math
import sys
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import click

from clpipe.base.about import FORMAT, FORMAT_KEY
from clpipe.chain.toml import value_text

Rows = list[tuple[str, ...]]


def short_text(value: Any) -> str:
    """Return a value as text, with numbers to four digits.

    >>> short_text(((1.0, 0.123456), (0.0, 2.0)))
    '[[1, 0.1235], [0, 2]]'
    """
    if isinstance(value, tuple):
        return f"[{', '.join(map(short_text, value))}]"
    if value is None:
        return "none"
    plain = not isinstance(value, float) or value.is_integer()
    return value_text(value) if plain else f"{value:.4g}"


def number(value: float, form: str = ".3g") -> str:
    """Return a measured number as text, or a dash for NaN.

    >>> number(0.01234), number(math.nan)
    ('0.0123', '-')
    """
    return "-" if math.isnan(value) else f"{value:{form}}"


def show(headings: Sequence[str], rows: Iterable[Sequence[str]], left: int | None = None) -> None:
    """Print a table.

    Args:
        headings: the headings of the columns.
        rows: the rows, with a text for each column.
        left: the number of columns that are aligned left; the others are aligned right. None
            aligns all left.
    """
    # Imported here, because --json does not need this module.
    from rich.console import Console
    from rich.table import Table

    table = Table(box=None, pad_edge=False)
    for number, heading in enumerate(headings):
        table.add_column(heading, justify="left" if left is None or number < left else "right")
    for row in rows:
        table.add_row(*row)
    # In a pipe, lines may be long. Markup is off, because cells may contain file names.
    width = None if sys.stdout.isatty() else 140
    Console(width=width, highlight=False, markup=False, emoji=False).print(table)


def show_json(values: Mapping[str, Any]) -> None:
    """Print values as JSON, with the number of the format; see :mod:`clpipe.commands.schema`."""
    click.echo(json.dumps({FORMAT_KEY: FORMAT, **values}, indent=2))
