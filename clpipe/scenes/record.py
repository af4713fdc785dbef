"""What a dataset was made of, so that a folder holds one dataset only."""

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from clpipe.base.errors import RequestError
from clpipe.base.files import write_new
from clpipe.base.reading import parse_json, read_bytes

RECORD = "dataset.json"


def read_record(folder: Path, made_of: Mapping[str, Any]) -> dict[str, Any]:
    """What is known of a folder's dataset, which must have been made of the same; {} of a new one.

    Args:
        folder: of the dataset.
        made_of: what its renders depend on, as JSON values.

    Raises:
        RequestError: it holds another one, or a file that clpipe did not write.
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
        raise RequestError(f"{path}: clpipe did not write it; choose another output folder")
    for key in dict.fromkeys((*before, *made_of)):
        if before.get(key) != made_of.get(key):
            raise RequestError(
                f"{folder}: holds a dataset with {key} {json.dumps(before.get(key))}, and "
                f"{json.dumps(made_of.get(key))} is asked for; choose another output folder"
            )
    return known or {}


def keep_said(folder: Path, said: Mapping[str, str | None]) -> dict[str, str]:
    """What was said of a folder's dataset now, else before: kept for the next time.

    Args:
        folder: of the dataset, which has a record.
        said: texts by their names; None is nothing new.

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
    """Write what a dataset is made of, and what was found in it.

    Raises:
        ImageError: it cannot be written.
    """
    record = {"made_of": made_of, **found}
    before = read_record(folder, made_of).get("said")
    record |= {"said": before} if before else {}
    write_new(folder / RECORD, (json.dumps(record, indent=1) + "\n").encode())
