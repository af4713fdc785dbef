"""Manifests: images in a table, .csv or .jsonl, with what is to be different for each."""

import csv
import io
import json
import os
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path, PurePosixPath
from typing import Any, Protocol

from clpipe.base.errors import RequestError
from clpipe.base.text import one_of
from clpipe.chain.chain import step_names
from clpipe.chain.keys import OUTPUT
from clpipe.chain.methods import base_name
from clpipe.chain.paths import from_folder
from clpipe.chain.registry import all_stages
from clpipe.chain.settings import Settings, overlay
from clpipe.chain.toml import toml_value
from clpipe.images.encoding import Output

MANIFEST_SUFFIXES = (".csv", ".jsonl")


TEXTS = ("path", "name")


OWN = (*TEXTS, "frames")  # columns that are no settings


PLAIN = ("iso", "camera", "seed")  # and settings that stand in no table


@dataclass(frozen=True, slots=True)
class Row:
    """One image of a manifest.

    ``name`` is what its outputs are called in the output folder, without an ending, where that is
    said, and ``key`` its image key. ``values`` are its settings, nested as in a configuration;
    ``frames`` how many frames are made of it. ``place`` is where all that stands.
    """

    path: Path
    key: str
    name: str
    values: Mapping[str, Any]
    frames: int | None
    place: str

    @property
    def stem(self) -> str:
        """The path of its outputs in the output folder, without an ending."""
        return self.name or str(PurePosixPath(self.key).with_suffix(""))


def read_manifest(path: Path) -> list[Row]:
    """The images of a manifest.

    A .csv has a header, commas and UTF-8; its cells are TOML values, else text, and an empty one
    says nothing. A .jsonl has an object a line, nested as a configuration or with dotted keys; null
    says nothing. Columns are ``path``, ``name``, ``frames``, ``iso``, ``camera``, ``seed`` and any
    ``stage.parameter``; those of a stage of one's own once it is loaded. Files are relative to the
    manifest.

    The image key is the name where there is one; else the path relative to the manifest's folder
    where it lies below that; else the file's name.

    Raises:
        RequestError: it cannot be read, names a column that there is not, or a row is wrong; the
            message gives the first row that is, and how many more are.
    """
    text = _text(path)
    read = _json_records if path.suffix.lower() == ".jsonl" else _csv_records
    faults: list[str] = []
    rows: list[Row] = []
    makers: dict[str, str] = {}
    for line, record in read(path, text):
        place = f"{path}, row {line}"
        try:
            row = _row(path.parent, place, record())
            other = makers.setdefault(row.stem, place)
            if other != place:
                raise RequestError(
                    f"it would make the same outputs as row {other.rpartition(' ')[2]}, "
                    f"{row.stem}; tell them apart in a column called name"
                )
            rows.append(row)
        except RequestError as error:
            faults.append(f"{place}: {error}")
    _report(faults)
    if not rows:
        raise RequestError(f"{path}: it has no rows, so there is nothing to do")
    return rows


class Said(Protocol):
    """An image with what is said of it alone; a row is one."""

    @property
    def path(self) -> Path: ...
    @property
    def values(self) -> Mapping[str, Any]: ...
    @property
    def place(self) -> str: ...


def check_rows(
    rows: Iterable[Said],
    settings: Settings,
    brings: Callable[[Path], bool] = lambda path: False,
) -> list[Settings]:
    """The settings of each row, every value checked, and nothing drawn yet.

    Args:
        rows: of a manifest, or what was made of them.
        settings: what holds where a row says nothing.
        brings: whether an image brings settings of its own, as a raw does, which may have another
            camera and other stages.

    Raises:
        RequestError: a value that is not allowed, a camera or ISO that there is not, or a stage
            that the chain has not; the message is as for :func:`read_manifest`.
    """
    steps = step_names(settings)
    faults: list[str] = []
    found: list[Settings] = []
    for row in rows:
        try:
            own = overlay(settings, row.values)
            if not brings(row.path):
                own.check_cameras()
                for step in row.values:
                    if step not in (*PLAIN, OUTPUT, *steps):
                        raise RequestError(one_of("stage in this chain", step, steps))
            found.append(own)
        except RequestError as error:
            faults.append(f"{row.place}: {error}")
    _report(faults)
    return found


def _report(faults: Sequence[str]) -> None:
    """Raise the first of several faults, with how many more there are."""
    if faults:
        more = len(faults) - 1
        rest = f"; and {more} more {'rows are' if more > 1 else 'row is'} wrong" if more else ""
        raise RequestError(faults[0] + rest)


def _text(path: Path) -> str:
    try:
        data = path.read_bytes()
    except (OSError, ValueError) as error:
        reason = getattr(error, "strerror", None) or error
        raise RequestError(f"{path}: cannot read this manifest: {reason}") from None
    try:
        return data.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        line = data[: error.start].count(b"\n") + 1
        raise RequestError(f"{path}, line {line}: not a text in UTF-8") from None


Record = Callable[[], dict[str, Any]]  # gives the values by column, or raises a RequestError


def _csv_records(path: Path, text: str) -> Iterator[tuple[int, Record]]:
    """The rows of a CSV, with the line on which each begins."""
    reader = csv.reader(io.StringIO(text, newline=""), skipinitialspace=True, strict=True)
    columns: list[str] | None = None
    line = 1
    try:
        for cells in reader:
            if cells and columns is None:
                columns = [cell.strip() for cell in cells]
                _check_header(f"{path}, row {line}", columns)
            elif cells and columns:
                yield line, partial(_by_column, columns, cells)
            line = reader.line_num + 1
    except csv.Error as error:
        raise RequestError(f"{path}, row {line}: not valid CSV: {error}") from None
    if columns is None:
        raise RequestError(f"{path}: it is empty; its first row names columns, such as path")


def _check_header(place: str, columns: Sequence[str]) -> None:
    """See that a header names each column once, and only such as there are.

    Raises:
        RequestError: it does not.
    """
    for number, column in enumerate(columns, 1):
        if not column:
            raise RequestError(f"{place}: column {number} has no name")
        if column in columns[: number - 1]:
            raise RequestError(f"{place}: there are two columns '{column}'")
    if "path" not in columns:
        commas = "" if len(columns) > 1 else "; columns are separated by commas"
        message = one_of("column", "path", columns).replace("unknown", "there is no")
        raise RequestError(f"{place}: {message.replace('; allowed:', '; found:')}{commas}")
    for column in columns:
        try:
            _check_column(column)
        except RequestError as error:
            raise RequestError(f"{place}: {error}") from None


def _by_column(columns: Sequence[str], cells: Sequence[str]) -> dict[str, Any]:
    """The cells of a row by their columns, those that say nothing left out.

    Raises:
        RequestError: there are more or fewer cells than columns.
    """
    if len(cells) != len(columns):
        listed = ", ".join(columns)
        raise RequestError(
            f"found {len(cells)} cells, but there are {len(columns)} columns ({listed}); "
            "a cell with commas stands in quotes"
        )
    pairs = zip(columns, cells, strict=True)
    given = {column: cell for column, cell in pairs if cell.strip()}
    return {k: v if k in TEXTS else toml_value(v.strip()) for k, v in given.items()}


def _json_records(path: Path, text: str) -> Iterator[tuple[int, Record]]:
    """The lines of a JSONL that are not empty, with their numbers."""
    for number, line in enumerate(text.split("\n"), 1):
        if line.strip():
            yield number, partial(_from_json, line)


def _from_json(line: str) -> dict[str, Any]:
    """The values of a JSON object by dotted columns, those that are null left out.

    Raises:
        RequestError: it is no object, has a key twice, or one that there is not.
    """
    try:
        found = json.loads(line, parse_constant=_refused, object_pairs_hook=_once)
    except json.JSONDecodeError as error:
        message = f"not valid JSON: {error.msg} at character {error.colno}"
        raise RequestError(message) from None
    except (ValueError, RecursionError) as error:
        raise RequestError(f"not valid JSON: {error}") from None
    if not isinstance(found, dict):
        raise RequestError(f"found {line.strip()[:40]}, but a row is an object: {{...}}")
    pairs: list[tuple[str, Any]] = []
    for key, value in found.items():
        if isinstance(value, dict) and "." not in key and key not in (*OWN, *PLAIN):
            pairs += [(f"{key}.{name}", one) for name, one in value.items()]
        else:
            pairs.append((key, value))
    for column, _ in pairs:
        _check_column(column)
    return {k: v for k, v in _once(pairs).items() if v is not None}


def _refused(constant: str) -> None:
    raise ValueError(f"found {constant}, which is no number")


def _once(pairs: Sequence[tuple[str, Any]]) -> dict[str, Any]:
    """Pairs as a dict.

    Raises:
        RequestError: a key is there twice.
    """
    found = dict(pairs)
    if len(found) < len(pairs):
        names = [name for name, _ in pairs]
        raise RequestError(f"'{next(n for n in names if names.count(n) > 1)}' is there twice")
    return found


def _check_column(name: str) -> None:
    """See that there is a column of that name.

    Raises:
        RequestError: there is none.
    """
    step, dot, parameter = name.partition(".")
    stage = all_stages().get(base_name(step))
    if not dot and name not in (*OWN, *PLAIN):
        if stage or step == OUTPUT:
            raise RequestError(f"{name}: its parameters have columns of their own: {name}.NAME")
        raise RequestError(one_of("column", name, (*OWN, *PLAIN)) + ", or stage.parameter")
    if dot and step != OUTPUT:
        if stage is None:
            raise RequestError(f"{name}: {one_of('stage', step, (*all_stages(), OUTPUT))}")
        known = dict.fromkeys(n for method in stage.methods for n in method.model_fields)
        if parameter not in ("method", *known):
            raise RequestError(one_of(f"parameter of {step}", parameter, ("method", *known)))
    elif dot and parameter not in Output.model_fields:
        raise RequestError(one_of(f"key of {OUTPUT}", parameter, Output.model_fields))


def _row(folder: Path, place: str, found: Mapping[str, Any]) -> Row:
    """A row from its values by column.

    Raises:
        RequestError: path, name or frames are not what they must be.
    """
    for column in TEXTS:
        _check_text(column, found.get(column, ""))
    path, name, frames = found.get("path", ""), found.get("name", ""), found.get("frames")
    if os.path.basename(path) in ("", ".", ".."):
        raise RequestError(f"path: found {path!r}, which names no image")
    check_output_name(name)
    if frames is not None and (type(frames) is not int or frames < 1):
        raise RequestError(f"frames: found {frames!r}, but it is a whole number from 1 on")
    values: dict[str, Any] = {}
    for column, value in found.items():
        step, _, parameter = column.partition(".")
        if parameter:
            values.setdefault(step, {})[parameter] = value
        elif column in PLAIN:
            values[column] = value
    key = name or _relative(folder, path)
    return Row(folder / path, key, name, from_folder(folder, values), frames, place)


def check_output_name(name: str) -> None:
    """See that the name of outputs, where there is one, stays in the output folder.

    Raises:
        RequestError: it does not.
    """
    if name and ("\0" in name or not {"", ".", ".."}.isdisjoint(name.split("/"))):
        raise RequestError(
            f"name: found {name!r}, but it is a path in the output folder, such as a/frame_0001"
        )


def _check_text(column: str, value: Any) -> None:
    """See that a value can be a part of a file's name.

    Raises:
        RequestError: it cannot.
    """
    if not isinstance(value, str):
        raise RequestError(f"{column}: found {value!r}, but it is text")
    try:
        value.encode()
    except UnicodeEncodeError:
        raise RequestError(f"{column}: found {value!r}, which is no text in UTF-8") from None
    if "\0" in value:
        raise RequestError(f"{column}: found {value!r}, but a file's name has no NUL")


def _relative(folder: Path, path: str) -> str:
    """A path relative to a folder where it lies below that; else the name of the file.

    >>> _relative(Path("a"), "b/../c/x.exr"), _relative(Path("a"), "../x.exr")
    ('c/x.exr', 'x.exr')
    """
    root = os.path.abspath(folder)
    whole = os.path.abspath(folder / path)
    below = os.path.relpath(whole, root)
    return os.path.basename(whole) if below.startswith("../") else below
