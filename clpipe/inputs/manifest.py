"""Manifests: images in a table, .csv or .jsonl, with values that hold for each alone."""

import csv
import io
import os
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path, PurePosixPath
from typing import Any, Protocol

from clpipe.base.errors import RequestError
from clpipe.base.reading import check_exists, read_bytes
from clpipe.base.text import one_of
from clpipe.base.urls import fetch, is_url, joined
from clpipe.chain.isos import check_cameras
from clpipe.chain.keys import TABLES, check_type
from clpipe.chain.methods import TABLE_MODELS, base_name
from clpipe.chain.options import OPTIONS
from clpipe.chain.paths import from_folder
from clpipe.chain.registry import all_stages
from clpipe.chain.settings import Settings, overlay
from clpipe.chain.toml import toml_value, value_text
from clpipe.inputs.tables import OWN, PLAIN, TEXTS, csv_records, json_records

MANIFEST_SUFFIXES = (".csv", ".jsonl")
ALONE = ("seed", "noise_key")  # values that no other depends on, and often differ by row
MANIFEST_BYTES = 256 * 2**20  # enough for two million rows


@dataclass(frozen=True, slots=True)
class Row:
    """One image of a manifest.

    Args:
        path: the file.
        key: its name among the inputs.
        name: the path of its outputs in the output folder, without an ending; "" follows the key.
        values: its settings, nested as in a configuration.
        frames: how many frames are made of it; None is what the request says.
        place: the manifest and the row, for messages.
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

    A .csv has a header, commas and UTF-8; its cells are TOML values, else text, and an empty cell
    sets nothing. A .jsonl has an object in each line, nested as a configuration or with dotted
    keys, and null sets nothing. Columns are ``path``, ``name``, ``frames``, ``iso``, ``camera``,
    ``lens``, ``focal_length``, ``aperture``, ``focus_distance``, ``seed``, ``noise_key``, ``skip``
    (names with spaces between, or a list) and any ``stage.parameter``, also of stage files that are
    loaded. Names of files are relative to the manifest.

    The key is the name where there is one; else the path relative to the manifest's folder
    where it lies below that; else the file's name.

    Args:
        path: the manifest.

    Raises:
        RequestError: it cannot be read, has a column that does not exist, or a row is wrong; the
            message is that of the first wrong row, with the number of others.
    """
    text = _text(path)
    read = json_records if path.suffix.lower() == ".jsonl" else csv_records
    faults: list[str] = []
    rows: list[Row] = []
    makers: dict[str, Row] = {}
    alike: dict[str, Mapping[str, Any]] = {}  # values that rows share are checked once
    for line, record in read(path, text, _check_column):
        place = f"{path}, row {line}"
        try:
            row = _row(path.parent, place, record(), alike)
            other = makers.setdefault(row.stem, row)
            if other is not row:
                raise RequestError(
                    f"it would make the same outputs as row {other.place.rpartition(' ')[2]}, "
                    f"{row.stem}; tell them apart in a column called name"
                )
            rows.append(row)
        except RequestError as error:
            faults.append(f"{place}: {error}")
    _report(faults)
    if not rows:
        raise RequestError(f"{path}: it has no rows, so there is nothing to do")
    return rows


def manifest_text(folder: Path, rows: Sequence[Row]) -> bytes:
    """A .csv that :func:`read_manifest` reads back as these rows.

    Args:
        folder: where it will lie.
        rows: with values as they are when read, names of files joined to a folder.
    """
    records: list[dict[str, str]] = []
    for row in rows:
        path = os.path.abspath(row.path)
        below = os.path.relpath(path, os.path.abspath(folder))
        cells = {"path": path if below.startswith("../") else below, "name": row.name}
        cells["frames"] = "" if row.frames is None else str(row.frames)
        for key, value in from_folder(Path.cwd(), row.values).items():
            table = value if key not in PLAIN and isinstance(value, Mapping) else None
            named = {key: value} if table is None else {f"{key}.{k}": v for k, v in table.items()}
            cells |= {name: _cell(each) for name, each in named.items()}
        records.append(cells)
    columns = dict.fromkeys(name for cells in records for name in cells)
    filled = [name for name in columns if any(cells.get(name) for cells in records)]
    text = io.StringIO(newline="")
    writer = csv.DictWriter(text, filled, "", "ignore", lineterminator="\n")
    writer.writeheader()
    writer.writerows(records)
    return text.getvalue().encode()


def _cell(value: Any) -> str:
    """A value as :func:`clpipe.inputs.tables.csv_records` reads it back.

    >>> _cell("gain"), _cell("100"), _cell(0.5)
    ('gain', '"100"', '0.5')
    """
    is_plain = isinstance(value, str) and toml_value(value.strip()) == value != ""
    return value if is_plain else value_text(value)


class HasValues(Protocol):
    """An image with values that hold for it alone, such as a :class:`Row`."""

    @property
    def path(self) -> Path: ...
    @property
    def values(self) -> Mapping[str, Any]: ...
    @property
    def place(self) -> str: ...


def check_rows(
    rows: Iterable[HasValues],
    settings: Settings,
    carries: Callable[[Path], bool] = lambda path: False,
) -> list[Settings]:
    """The settings of each row, every value checked and nothing drawn.

    Args:
        rows: of a manifest, or jobs made of them.
        settings: what holds where a row sets nothing.
        carries: whether an image carries settings of its own, as a raw does; it may then have
            another camera and other stages.

    Raises:
        RequestError: a value that is not allowed, a camera or ISO that does not exist, or a stage
            that is not in the chain; the message is as for :func:`read_manifest`.
    """
    steps = settings.step_names
    faults: list[str] = []
    checked: list[Settings] = []
    known: dict[tuple[str, bool], Settings] = {}  # rows may share their values
    for row in rows:
        carried = carries(row.path)
        alone = {
            key: value
            for key, value in row.values.items()
            if key in ALONE and not isinstance(value, Mapping)
        }
        others = {key: value for key, value in row.values.items() if key not in alone}
        alike = repr(others), carried
        try:
            if alike not in known:
                own = overlay(settings, others)
                if not carried:
                    check_cameras(own)
                    for step in others:
                        if step not in (*PLAIN, *TABLES, *steps):
                            raise RequestError(one_of("stage in this chain", step, steps))
                known[alike] = own
            for key, value in alone.items():
                check_type(key, value)
            checked.append(replace(known[alike], **alone) if alone else known[alike])
        except RequestError as error:
            faults.append(f"{row.place}: {error}")
    _report(faults)
    return checked


def _report(faults: Sequence[str]) -> None:
    """Raise the first fault, where there is one, with the number of others."""
    if faults:
        more = len(faults) - 1
        rest = f"; and {more} more {'rows are' if more > 1 else 'row is'} wrong" if more else ""
        raise RequestError(faults[0] + rest)


def _text(path: Path) -> str:
    fetch(path)
    check_exists(path)
    try:
        data = read_bytes(path, MANIFEST_BYTES)
    except OSError as error:
        raise RequestError(f"{path}: cannot read this manifest: {error.strerror}") from None
    try:
        return data.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        line = data[: error.start].count(b"\n") + 1
        raise RequestError(f"{path}, line {line}: not a text in UTF-8") from None


def _check_column(name: str) -> None:
    """See that a column exists.

    Raises:
        RequestError: it does not.
    """
    step, dot, parameter = name.partition(".")
    stage = all_stages().get(base_name(step))
    if not dot and name not in (*OWN, *PLAIN):
        if stage or step in TABLES:
            raise RequestError(f"{name}: its parameters have columns of their own: {name}.NAME")
        raise RequestError(one_of("column", name, (*OWN, *PLAIN)) + ", or stage.parameter")
    if dot and step not in TABLES:
        if stage is None:
            raise RequestError(f"{name}: {one_of('stage', step, (*all_stages(), *TABLES))}")
        names = dict.fromkeys(n for method in stage.methods for n in method.model_fields)
        if parameter not in ("method", *names):
            raise RequestError(one_of(f"parameter of {step}", parameter, ("method", *names)))
    elif dot and parameter not in (fields := TABLE_MODELS[step].model_fields):
        raise RequestError(one_of(f"key of {step}", parameter, fields))


def _row(
    folder: Path, place: str, record: Mapping[str, Any], alike: dict[str, Mapping[str, Any]]
) -> Row:
    """A row from its values by column.

    Args:
        folder: of the manifest.
        place: the manifest and the row.
        record: the values.
        alike: values of other rows, which are shared where they are the same.

    Raises:
        RequestError: path, name or frames are not allowed.
    """
    for column in TEXTS:
        _check_text(column, record.get(column, ""))
    path, name, frames = record.get("path", ""), record.get("name", ""), record.get("frames")
    if os.path.basename(path) in ("", ".", ".."):
        raise RequestError(f"path: found {path!r}, which names no image")
    _check_name(name)
    if frames is not None and not OPTIONS["frames"].allows(frames):
        raise RequestError(f"frames: found {frames!r}, but it is {OPTIONS['frames'].allowed}")
    values: dict[str, Any] = {}
    for column, value in record.items():
        step, _, parameter = column.partition(".")
        if parameter:
            values.setdefault(step, {})[parameter] = value
        elif column == "skip" and isinstance(value, str):
            values[column] = value.split()
        elif column in PLAIN:
            values[column] = value
    own = joined(folder, path)
    key = name or (own.name if is_url(path) else key_of(folder, own))
    values = from_folder(folder, values)
    return Row(own, key, name, alike.setdefault(repr(values), values), frames, place)


def check_output_name(name: str) -> None:
    """Check that a name of outputs stays in the output folder; "" is allowed.

    Raises:
        RequestError: it does not.
    """
    parts = name.replace(os.sep, "/").split("/")
    has_drive = os.path.splitdrive(name)[0]  # as in C:name, on Windows
    if name and ("\0" in name or has_drive or not {"", ".", ".."}.isdisjoint(parts)):
        raise RequestError(
            f"name: found {name!r}, but it is a path in the output folder, such as a/frame_0001"
        )


def _check_name(name: str) -> None:
    """Check the name that a row gives its outputs; "" is allowed.

    Hidden pictures are rejected because reports and later runs do not see them.

    Raises:
        RequestError: it leaves the output folder, or a part of it is hidden or looks like another
            path.
    """
    check_output_name(name)
    if "\\" in name or any(part.startswith((".", "~")) for part in name.split("/")):
        raise RequestError(
            f"name: found {name!r}, but a name has no backslash, and no part begins with a "
            "period or ~; choose another, such as a/frame_0001"
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


def key_of(folder: Path, path: Path) -> str:
    """The key of an image without a name: its path where it lies below a manifest's folder; else
    the name of the file.

    >>> key_of(Path("a"), Path("a/b/../c/x.exr")), key_of(Path("a"), Path("x.exr"))
    ('c/x.exr', 'x.exr')
    """
    whole = os.path.abspath(path)
    below = Path(os.path.relpath(whole, os.path.abspath(folder))).as_posix()
    return os.path.basename(whole) if below.startswith("../") else below
