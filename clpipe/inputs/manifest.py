"""Manifests: tables of images (.csv or .jsonl), with settings for each image."""

import csv
import io
import os
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from clpipe.base.errors import RequestError
from clpipe.base.reading import check_exists, read_bytes
from clpipe.base.text import unknown_name
from clpipe.base.url_text import is_url
from clpipe.base.urls import fetch, join_url
from clpipe.chain.isos import check_cameras
from clpipe.chain.keys import TABLES, check_type
from clpipe.chain.methods import TABLE_MODELS, base_name
from clpipe.chain.options import OPTIONS
from clpipe.chain.paths import resolve_paths
from clpipe.chain.registry import all_stages, stage_in
from clpipe.chain.settings import Settings, overlay
from clpipe.chain.toml import toml_value, value_text
from clpipe.inputs.jobs import Job
from clpipe.inputs.tables import (
    NON_SETTINGS,
    TEXT_COLUMNS,
    TOP_LEVEL_KEYS,
    csv_records,
    json_records,
    list_records,
)
from clpipe.inputs.times import decimal_text, time_of
from clpipe.stage import StageRole

MANIFEST_SUFFIXES = (".csv", ".jsonl", ".txt")
# No other setting depends on these keys, and their values often differ by row.
INDEPENDENT_KEYS = ("seed", "noise_key")
MANIFEST_BYTES = 256 * 2**20  # bytes; enough for two million rows


def read_manifest(path: Path) -> list[Job]:
    """Return the rows of a manifest.

    A .csv file is UTF-8 text with a header and commas between cells. A cell is a TOML value, or
    text if it is not valid TOML. An empty cell sets nothing. A .jsonl file has one object per line,
    nested like a configuration or with dotted keys, and null sets nothing.

    Columns are ``path``, ``key``, ``name``, ``time``, ``frames``, ``iso``, ``camera``, ``lens``,
    ``focal_length``, ``aperture``, ``focus_distance``, ``seed``, ``noise_key`` and ``skip`` (a
    list, or names with spaces between them). Any ``stage.parameter`` is a column, including those
    of loaded stage files. File names are relative to the manifest.

    A .txt file, or a .csv file that begins with #, is a list of images with time stamps, see
    :func:`clpipe.inputs.tables.list_records`.

    Without the column ``key``, the key of a row is its name. Without either, it is the path
    relative to the manifest's folder, or the file's name if the file is outside that folder.

    Args:
        path: the manifest.

    Raises:
        RequestError: the manifest cannot be read, has an unknown column, or has a wrong row. The
            message describes the first wrong row, and counts the others.
    """
    text = _text(path)
    read = {".jsonl": json_records, ".txt": list_records}.get(path.suffix.lower(), csv_records)
    if text.startswith("#"):  # EuroC's data.csv
        read = list_records
    errors: list[str] = []
    rows: list[Job] = []
    by_stem: dict[str, Job] = {}
    shared_values: dict[str, Mapping[str, Any]] = {}  # values that rows share are checked once
    for line, record in read(path, text, _check_column):
        location = f"{path}, row {line}"
        try:
            row = _row(path.parent, location, record(), shared_values)
            other = by_stem.setdefault(row.stem, row)
            if other is not row:
                raise RequestError(
                    "this row would write the same outputs as row "
                    f"{other.location.rpartition(' ')[2]}, {row.stem}; give them different names "
                    "in a column called name"
                )
            rows.append(row)
        except RequestError as error:
            errors.append(f"{location}: {error}")
    _raise_first(errors)
    if not rows:
        raise RequestError(f"{path}: this manifest has no rows; add one for each image")
    return rows


def manifest_text(folder: Path, rows: Sequence[Job]) -> bytes:
    """Return the bytes of a .csv that :func:`read_manifest` reads back as these rows.

    Args:
        folder: the folder that the manifest will be in.
        rows: the rows. Values that name files are complete paths.
    """
    records: list[dict[str, str]] = []
    for row in rows:
        path = os.path.abspath(row.path)
        below = os.path.relpath(path, os.path.abspath(folder))
        key = "" if row.key == (row.name or key_of(folder, row.path)) else row.key
        cells = {"path": path if below.startswith("../") else below, "key": key, "name": row.name}
        cells["time"] = "" if row.time is None else decimal_text(row.time)
        cells["frames"] = "" if row.frames is None else str(row.frames)
        for key, value in resolve_paths(Path.cwd(), row.values).items():
            table = value if key not in TOP_LEVEL_KEYS and isinstance(value, Mapping) else None
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
    """Return the cell that :func:`clpipe.inputs.tables.csv_records` reads back as this value.

    >>> _cell("gain"), _cell("100"), _cell(0.5)
    ('gain', '"100"', '0.5')
    """
    is_plain = isinstance(value, str) and toml_value(value.strip()) == value != ""
    return value if is_plain else value_text(value)


def check_rows(
    rows: Iterable[Job],
    settings: Settings,
    has_embedded_settings: Callable[[Path], bool] = lambda path: False,
) -> list[Settings]:
    """Return the settings of each row, with every value checked and nothing drawn.

    Args:
        rows: the jobs.
        settings: the settings for what a row does not set.
        has_embedded_settings: returns whether an image contains settings, like a raw. Such an image
            may have another camera and other stages.

    Raises:
        RequestError: a value is not allowed, a camera or ISO does not exist, or a stage is not in
            the chain. The message is as for :func:`read_manifest`.
    """
    steps = (*settings.step_names, stage_in(StageRole.SPECTRUM).name)
    errors: list[str] = []
    checked: list[Settings] = []
    checked_settings: dict[tuple[str, bool], Settings] = {}  # for rows with equal values
    for row in rows:
        is_embedded = has_embedded_settings(row.path)
        independent = {
            key: value
            for key, value in row.values.items()
            if key in INDEPENDENT_KEYS and not isinstance(value, Mapping)
        }
        others = {key: value for key, value in row.values.items() if key not in independent}
        cache_key = repr(others), is_embedded
        try:
            if cache_key not in checked_settings:
                row_settings = overlay(settings, others)
                if not is_embedded:
                    check_cameras(row_settings)
                    for step in others:
                        if step not in (*TOP_LEVEL_KEYS, *TABLES, *steps):
                            raise RequestError(unknown_name("stage in this chain", step, steps))
                checked_settings[cache_key] = row_settings
            for key, value in independent.items():
                check_type(key, value)
            checked.append(
                replace(checked_settings[cache_key], **independent)
                if independent
                else checked_settings[cache_key]
            )
        except RequestError as error:
            errors.append(f"{row.location}: {error}")
    _raise_first(errors)
    return checked


def _raise_first(errors: Sequence[str]) -> None:
    """Raise the first fault, if there is one, with the number of others."""
    if errors:
        more = len(errors) - 1
        rest = f"; {more} more {'rows are' if more > 1 else 'row is'} also wrong" if more else ""
        raise RequestError(errors[0] + rest)


def _text(path: Path) -> str:
    fetch(path)
    check_exists(path)
    try:
        data = read_bytes(path, MANIFEST_BYTES)
    except OSError as error:
        raise RequestError(f"{path}: this manifest cannot be read: {error.strerror}") from None
    try:
        return data.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        line = data[: error.start].count(b"\n") + 1
        raise RequestError(
            f"{path}, line {line}: this is not UTF-8; save the manifest as UTF-8 text"
        ) from None


def _check_column(name: str) -> None:
    """Check that a column exists.

    Raises:
        RequestError: it does not.
    """
    step, dot, parameter = name.partition(".")
    stage = all_stages().get(base_name(step))
    if not dot and name not in (*NON_SETTINGS, *TOP_LEVEL_KEYS):
        if stage or step in TABLES:
            raise RequestError(
                f"{name} is not a column, but each of its parameters is; use {name}.PARAMETER"
            )
        raise RequestError(
            unknown_name("column", name, (*NON_SETTINGS, *TOP_LEVEL_KEYS)) + ", or stage.parameter"
        )
    if dot and step not in TABLES:
        if stage is None:
            raise RequestError(f"{name}: {unknown_name('stage', step, (*all_stages(), *TABLES))}")
        names = dict.fromkeys(n for method in stage.methods for n in method.model_fields)
        if parameter not in ("method", *names):
            raise RequestError(unknown_name(f"parameter of {step}", parameter, ("method", *names)))
    elif dot and parameter not in (fields := TABLE_MODELS[step].model_fields):
        raise RequestError(unknown_name(f"key of {step}", parameter, fields))


def _row(
    folder: Path, location: str, record: Mapping[str, Any], shared: dict[str, Mapping[str, Any]]
) -> Job:
    """Return a row, from its values by column.

    Args:
        folder: the folder of the manifest.
        location: the manifest and the row.
        record: the values.
        shared: values of earlier rows. Rows with equal values share one object.

    Raises:
        RequestError: path, name or frames are not allowed.
    """
    for column in TEXT_COLUMNS:
        _check_text(column, record.get(column, ""))
    path, name, frames = record.get("path", ""), record.get("name", ""), record.get("frames")
    key = record.get("key", "")
    if os.path.basename(path) in ("", ".", ".."):
        raise RequestError(f"path: found {path!r}, but expected the path of an image")
    check_output_name(key, "key")
    _check_name(name)
    if frames is not None and not OPTIONS["frames"].allows(frames):
        raise RequestError(f"frames: found {frames!r}, but expected {OPTIONS['frames'].allowed}")
    values: dict[str, Any] = {}
    for column, value in record.items():
        step, _, parameter = column.partition(".")
        if parameter:
            values.setdefault(step, {})[parameter] = value
        elif column == "skip" and isinstance(value, str):
            values[column] = value.split()
        elif column in TOP_LEVEL_KEYS:
            values[column] = value
    image_path = join_url(folder, path)
    key = key or name or (image_path.name if is_url(path) else key_of(folder, image_path))
    values = resolve_paths(folder, values)
    stamp = record.get("time")
    time = None if stamp is None else time_of(stamp)
    shared_values = shared.setdefault(repr(values), values)
    return Job(image_path, key, name, True, shared_values, frames, location=location, time=time)


def check_output_name(name: str, column: str = "name") -> None:
    """Check that a name of outputs stays in the output directory; "" is allowed.

    Args:
        name: the name.
        column: what sets it, for the message.

    Raises:
        RequestError: it does not.
    """
    parts = name.replace(os.sep, "/").split("/")
    has_drive = os.path.splitdrive(name)[0]  # for example C:name, on Windows
    if name and ("\0" in name or has_drive or not {"", ".", ".."}.isdisjoint(parts)):
        raise RequestError(
            f"{column}: found {name!r}, but expected a path in the output directory, such as "
            "a/frame_0001"
        )


def _check_name(name: str) -> None:
    """Check the name that a row gives its outputs; "" is allowed.

    Hidden pictures are rejected because reports and later runs do not see them.

    Raises:
        RequestError: the name leaves the output directory, contains a backslash, or has a part that
            begins with a period or ~.
    """
    check_output_name(name)
    if "\\" in name or any(part.startswith((".", "~")) for part in name.split("/")):
        raise RequestError(
            f"name: found {name!r}, but a name may not contain a backslash, and no part may begin "
            "with a period or ~; choose another, such as a/frame_0001"
        )


def _check_text(column: str, value: Any) -> None:
    """Check that a value can be part of a file name.

    Raises:
        RequestError: it cannot.
    """
    if not isinstance(value, str):
        raise RequestError(f"{column}: found {value!r}, but expected text; put it in quotes")
    try:
        value.encode()
    except UnicodeEncodeError:
        raise RequestError(
            f"{column}: found {value!r}, but expected characters that UTF-8 can encode"
        ) from None
    if "\0" in value:
        raise RequestError(f"{column}: found {value!r}, but a file name may not contain NUL")


def key_of(folder: Path, path: Path) -> str:
    """Return the key of an image without a name.

    It is the path relative to the manifest's folder, or the file's name if it is outside.

    >>> key_of(Path("a"), Path("a/b/../c/x.exr")), key_of(Path("a"), Path("x.exr"))
    ('c/x.exr', 'x.exr')
    """
    whole = os.path.abspath(path)
    below = Path(os.path.relpath(whole, os.path.abspath(folder))).as_posix()
    return os.path.basename(whole) if below.startswith("../") else below
