"""The record of what a dataset was made from, which prevents two datasets in one folder."""

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from clpipe.base.errors import RequestError
from clpipe.base.files import write_new
from clpipe.base.reading import parse_json, read_bytes

RECORD = "dataset.json"


def read_record(folder: Path, origin: Mapping[str, Any]) -> dict[str, Any]:
    """Return the record of a folder's dataset; {} if there is none yet.

    Args:
        folder: the folder of the dataset.
        origin: the values on which its renders depend, as JSON values.

    Raises:
        RequestError: the folder contains another dataset, or a record that clpipe did not write.
    """
    path = folder / RECORD
    try:
        stored = parse_json(read_bytes(path))
    except FileNotFoundError:
        return {}
    except (OSError, ValueError):
        stored = None
    earlier = stored.get("made_of") if isinstance(stored, dict) else None
    if not isinstance(earlier, dict):
        raise RequestError(
            f"{path}: clpipe did not write this file; choose another output directory"
        )
    for key in dict.fromkeys((*earlier, *origin)):
        if earlier.get(key) != origin.get(key):
            raise RequestError(
                f"{folder}: this folder has a dataset with {key} {json.dumps(earlier.get(key))}, "
                f"but the request has {json.dumps(origin.get(key))}; choose another output "
                "directory"
            )
    return stored or {}


def store_credits(folder: Path, credits: Mapping[str, str | None]) -> dict[str, str]:
    """Store the licence and author of a dataset in its record, and return the stored ones.

    Args:
        folder: the folder of the dataset, which has a record.
        credits: texts by name. None keeps the stored text.

    Raises:
        ImageError: the record cannot be written.
    """
    path = folder / RECORD
    stored = parse_json(read_bytes(path))
    earlier = stored.get("said", {})
    kept = {name: text or str(earlier.get(name, "")) for name, text in credits.items()}
    if kept != earlier:
        write_new(path, (json.dumps({**stored, "said": kept}, indent=1) + "\n").encode())
    return kept


def write_record(folder: Path, origin: Mapping[str, Any], found: Mapping[str, Any]) -> None:
    """Write the record of a dataset: the values that its renders depend on, and its contents.

    Raises:
        ImageError: the record cannot be written.
    """
    record = {"made_of": origin, **found}
    earlier = read_record(folder, origin).get("said")
    record |= {"said": earlier} if earlier else {}
    write_new(folder / RECORD, (json.dumps(record, indent=1) + "\n").encode())
