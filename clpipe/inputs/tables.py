"""Reads the tables of manifests, CSV and JSONL, as values by column.

A row is parsed only when its record is called, so that one wrong row does not hide the others.
"""

import csv
import io
import json
import re
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from fractions import Fraction
from functools import partial
from pathlib import Path
from typing import Any

from clpipe.base.errors import RequestError
from clpipe.base.text import unknown_name
from clpipe.chain.keys import CODE, KEYS
from clpipe.chain.toml import toml_value

# Returns the values of a row by column, or raises RequestError.
Record = Callable[[], dict[str, Any]]

TEXT_COLUMNS = ("path", "key", "name")  # columns that are not parsed as TOML values

NON_SETTINGS = (*TEXT_COLUMNS, "time", "frames")  # columns that are not settings

# Columns with settings that do not belong to a table.
TOP_LEVEL_KEYS = tuple(key for key in KEYS if key not in (CODE, "dump", "stages"))


def csv_records(
    path: Path, text: str, check_column: Callable[[str], None]
) -> Iterator[tuple[int, Record]]:
    """Yield the rows of a CSV, each with the number of its first line.

    Args:
        path: the file, for messages.
        text: its text.
        check_column: raises a RequestError for a column that does not exist.

    Raises:
        RequestError: the CSV is not valid or empty, or its header is wrong.
    """
    reader = csv.reader(io.StringIO(text, newline=""), skipinitialspace=True, strict=True)
    columns: list[str] | None = None
    line = 1
    try:
        for cells in reader:
            if cells and columns is None:
                columns = [cell.strip() for cell in cells]
                _check_header(f"{path}, row {line}", columns, check_column)
            elif cells and columns:
                yield line, partial(_by_column, columns, cells)
            line = reader.line_num + 1
    except csv.Error as error:
        raise RequestError(f"{path}, row {line}: this is not valid CSV: {error}") from None
    if columns is None:
        raise RequestError(
            f"{path}: this manifest is empty; its first row must name columns, such as path"
        )


def _check_header(place: str, columns: Sequence[str], check_column: Callable[[str], None]) -> None:
    """Check that a header names each column once, and only columns that exist.

    Raises:
        RequestError: it does not.
    """
    counts = Counter(columns)
    for number, column in enumerate(columns, 1):
        if not column:
            raise RequestError(f"{place}: column {number} has no name; name or remove it")
        if counts[column] > 1:
            raise RequestError(f"{place}: there are two columns '{column}'; remove one of them")
    if "path" not in columns:
        commas = "" if len(columns) > 1 else "; columns are separated by commas"
        message = unknown_name("column", "path", columns).replace("unknown", "there is no")
        raise RequestError(f"{place}: {message.replace('; allowed:', '; found:')}{commas}")
    for column in columns:
        try:
            check_column(column)
        except RequestError as error:
            raise RequestError(f"{place}: {error}") from None


def _by_column(columns: Sequence[str], cells: Sequence[str]) -> dict[str, Any]:
    """Return the values of a row by column, without empty cells.

    Raises:
        RequestError: there are more or fewer cells than columns.
    """
    if len(cells) != len(columns):
        listed = ", ".join(columns)
        raise RequestError(
            f"found {len(cells)} cells, but there are {len(columns)} columns ({listed}); "
            "put a cell that contains commas in quotes"
        )
    pairs = zip(columns, cells, strict=True)
    filled = {column: cell for column, cell in pairs if cell.strip()}
    return {k: v if k in TEXT_COLUMNS else toml_value(v.strip()) for k, v in filled.items()}


def list_records(path: Path, text: str, _check_column: object) -> Iterator[tuple[int, Record]]:
    """Yield the rows of a list of images with time stamps, as of the TUM and EuroC datasets.

    A row of TUM's rgb.txt is a time stamp and a file. The files of EuroC's data.csv are in the
    folder data next to it. Lines that begin with # are comments.

    For the arguments, see :func:`csv_records`.
    """
    folder = "data/" if path.suffix.lower() == ".csv" else ""
    for number, line in enumerate(text.splitlines(), 1):
        if line.strip() and not line.startswith("#"):
            yield number, partial(_from_list, folder, re.split(r"[ ,\t]+", line.strip()))


def _from_list(folder: str, words: Sequence[str]) -> dict[str, Any]:
    """Return the path and the time of a row of a list.

    Raises:
        RequestError: the row has no time stamp, or not one file.
    """
    if len(words) != 2 or not re.fullmatch(r"\d+(\.\d*)?", words[0]):
        raise RequestError(
            f"found {' '.join(words)[:60]!r}, but expected a time stamp and the path of an image. "
            "For other columns, use a manifest with the columns path and time"
        )
    return {"path": folder + words[1], "time": Fraction(words[0])}


def json_records(
    path: Path, text: str, check_column: Callable[[str], None]
) -> Iterator[tuple[int, Record]]:
    """Yield the lines of a JSONL that are not empty, with their numbers.

    For the arguments, see :func:`csv_records`.
    """
    for number, line in enumerate(text.split("\n"), 1):
        if line.strip():
            yield number, partial(_from_json, line, check_column)


def _from_json(line: str, check_column: Callable[[str], None]) -> dict[str, Any]:
    """Return a JSON object as values by dotted column, such as ``sensor_noise.a``, without nulls.

    Raises:
        RequestError: the line is not an object, or has a repeated key or an unknown column.
    """
    try:
        row = json.loads(line, parse_constant=_refuse_constant, object_pairs_hook=_unique)
    except json.JSONDecodeError as error:
        message = f"this is not valid JSON: {error.msg} at character {error.colno}"
        raise RequestError(message) from None
    except RequestError:
        raise
    except (ValueError, RecursionError) as error:
        raise RequestError(f"this is not valid JSON: {error}") from None
    if not isinstance(row, dict):
        raise RequestError(f"found {line.strip()[:40]}, but expected an object: {{...}}")
    pairs: list[tuple[str, Any]] = []
    for key, value in row.items():
        if (
            isinstance(value, dict)
            and "." not in key
            and key not in (*NON_SETTINGS, *TOP_LEVEL_KEYS)
        ):
            pairs += [(f"{key}.{name}", item) for name, item in value.items()]
        else:
            pairs.append((key, value))
    for column, _ in pairs:
        check_column(column)
    return {k: v for k, v in _unique(pairs).items() if v is not None}


def _refuse_constant(constant: str) -> None:
    raise ValueError(f"{constant} is not a number in JSON")


def _unique(pairs: Sequence[tuple[str, Any]]) -> dict[str, Any]:
    """Return pairs as a dict.

    Raises:
        RequestError: a key occurs twice.
    """
    values = dict(pairs)
    if len(values) < len(pairs):
        names = [name for name, _ in pairs]
        repeated = next(n for n in names if names.count(n) > 1)
        raise RequestError(f"'{repeated}' occurs twice; remove one of them")
    return values
