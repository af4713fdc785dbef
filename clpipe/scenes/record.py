"""The record of what a dataset was made from, which prevents two datasets in one folder."""

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from clpipe.base.errors import RequestError
from clpipe.base.files import write_new
from clpipe.base.reading import parse_json, read_bytes

RECORD = "dataset.json"


def read_record(folder: Path, made_of: Mapping[str, Any]) -> dict[str, Any]:
    """Return the record of a folder's dataset; {} if there is none yet.

    Args:
        folder: the folder of the dataset.
        made_of: the values on which its renders depend, as JSON values.

    Raises:
        RequestError: the folder contains another dataset, or a record that clpipe did not write.
    """
    path = folder / RECORD
    try:
        known = parse_json(read_bytes(path))
    except FileNotFoundError:
        return {}
    except (OSError, ValueError):
        known = None
    before = known.get("made_of") if isinstance(known, dict) else None
    if not isinstance(before, dict):
        raise RequestError(
            f"{path}: clpipe did not write this file; choose another output directory"
        )
    for key in dict.fromkeys((*before, *made_of)):
        if before.get(key) != made_of.get(key):
            raise RequestError(
                f"{folder}: this folder has a dataset with {key} {json.dumps(before.get(key))}, "
                f"but the request has {json.dumps(made_of.get(key))}; choose another output "
                "directory"
            )
    return known or {}


def keep_said(folder: Path, said: Mapping[str, str | None]) -> dict[str, str]:
    """Store texts about a dataset in its record, and return them with those stored before.

    Args:
        folder: the folder of the dataset, which has a record.
        said: texts by name; None keeps the earlier text.

    Raises:
        ImageError: the record cannot be written.
    """
    path = folder / RECORD
    known = parse_json(read_bytes(path))
    before = known.get("said", {})
    kept = {name: text or str(before.get(name, "")) for name, text in said.items()}
    if kept != before:
        write_new(path, (json.dumps({**known, "said": kept}, indent=1) + "\n").encode())
    return kept


def write_record(folder: Path, made_of: Mapping[str, Any], found: Mapping[str, Any]) -> None:
    """Write the record of a dataset: the values that its renders depend on, and its contents.

    Raises:
        ImageError: the record cannot be written.
    """
    record = {"made_of": made_of, **found}
    before = read_record(folder, made_of).get("said")
    record |= {"said": before} if before else {}
    write_new(folder / RECORD, (json.dumps(record, indent=1) + "\n").encode())
