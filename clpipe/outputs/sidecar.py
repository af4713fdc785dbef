"""Sidecar files: JSON that contains its own digest, so that edits are noticed.

:func:`sidecar_bytes` formats all sidecars, and :func:`parse_sidecar` reads them. The digest
protects against accidents and edits, not against forgery. :mod:`clpipe.outputs.record` makes the
contents.
"""

import hashlib
import json
import os
import re
from collections.abc import Iterator, Mapping, Sequence
from functools import cached_property
from pathlib import Path
from typing import Any

from pydantic_core import from_json

from clpipe.base.about import FORMAT, FORMAT_KEY
from clpipe.base.errors import ImageError
from clpipe.base.files import sync_folder, write_atomic
from clpipe.base.reading import parse_json, read_bytes

SIDECAR = "json"  # the extension of sidecars

VERSION_KEY = "clpipe"  # the first key of every sidecar

DIGEST_KEY = "sidecar_sha256"  # the last key: the SHA-256 of all lines before its own

BEGINNING = b'{\n  "%b": ' % VERSION_KEY.encode()

# The beginning and end of a sidecar identify it even if it was cut off or edited.
_BEGINNING = re.compile(rb'\s*\{\s*"%b"\s*:' % VERSION_KEY.encode())
_END = re.compile(rb'"%b"\s*:' % DIGEST_KEY.encode())


to_json = json.JSONEncoder().encode  # json.dumps without checking its options


class SidecarError(ImageError):
    """A sidecar was edited, cut off or damaged after clpipe wrote it."""

    def __init__(self, name: Path | str) -> None:
        super().__init__(
            f"{name}: this sidecar was changed after clpipe wrote it (its {DIGEST_KEY} does not "
            "match), so it is not used. To restore it, repeat the same clpipe run. To change "
            "settings, use options or a configuration"
        )


class NewerFormatError(SidecarError):
    """A newer clpipe wrote a file, in a format that this one does not know."""

    def __init__(self, name: Path | str, number: Any) -> None:
        ImageError.__init__(
            self,
            f"{name}: a newer clpipe wrote this file: its format has number {number}, and this "
            f"version knows {FORMAT}. Install the newer version, or use another output directory",
        )


def check_format(values: Mapping[str, Any], name: Path | str) -> None:
    """Check that a file has a known format. Files from before the numbers have none, or 0.

    Raises:
        NewerFormatError: a newer version wrote it.
    """
    number = values.get(FORMAT_KEY, 0)
    if not isinstance(number, int) or number > FORMAT:
        raise NewerFormatError(name, number)


def sidecar_bytes(record: Mapping[str, Any]) -> bytes:
    r"""Return the bytes of a sidecar: its values, then the digest of all lines before it.

    ``head -n -2 NAME.json | sha256sum`` computes that digest.

    >>> sidecar_bytes({"a": 1})[:28]
    b'{\n  "a": 1,\n  "sidecar_sha25'
    """
    head = json_text(record).removesuffix("\n}\n").encode() + b",\n"
    return head + _digest_lines(head)


def parse_sidecar(data: bytes, name: Path | str) -> dict[str, Any] | None:
    """Return the values of an unchanged sidecar. Only its key :data:`VERSION_KEY` is guaranteed.

    Args:
        data: the bytes of a file.
        name: the name of the file, for the message.

    Returns:
        The values, or None if the file is empty or not a sidecar of clpipe.

    Raises:
        SidecarError: it was edited, cut off or damaged, or a newer version wrote it.
    """
    end = data.rfind(b'  "%b": "' % DIGEST_KEY.encode())
    if end > 0 and data[end:] == _digest_lines(data[:end]):
        try:
            # pydantic's parser takes a third of the time of json's parser. It rejects the escapes
            # that json writes for file names that are not UTF-8.
            values = parse_json(data) if b"\\ud" in data else from_json(data)
        except ValueError:
            values = None
        if isinstance(values, dict) and VERSION_KEY in values:
            check_format(values, name)
            return values
    if is_sidecar(data):
        raise SidecarError(name)
    return None


def is_sidecar(data: bytes) -> bool:
    """Return whether the bytes of a file are a sidecar, or the remains of one."""
    is_cut = BEGINNING.startswith(data.rstrip(b"\0") or b"-")
    return is_cut or bool(_BEGINNING.match(data) or _END.search(data))


def read_sidecar(path: Path) -> dict[str, Any]:
    """Return the values of a sidecar, see :func:`parse_sidecar`.

    Raises:
        FileNotFoundError: it is missing, or empty after a loss of power.
        SidecarError: it was edited, cut off or damaged.
        ImageError: it cannot be read, or clpipe did not write it.
    """
    try:
        data = read_bytes(path)
    except FileNotFoundError:
        raise
    except OSError as error:
        raise ImageError(f"{path}: this file cannot be read: {error.strerror}") from None
    if not data.strip(b"\0"):
        raise FileNotFoundError(path)
    values = parse_sidecar(data, path)
    if values is None:
        raise ImageError(
            f"{path}: clpipe did not write this file, and would overwrite it with a sidecar; "
            "move it, choose another output directory, or use --redo all"
        )
    return values


def sidecar_files(folder: Path) -> Iterator[Path]:
    """Yield the files below a folder that may be sidecars, sorted, without hidden ones."""
    for parent, folders, names in os.walk(folder):
        folders[:] = sorted(name for name in folders if not name.startswith("."))
        for name in sorted(names):
            if name.endswith(f".{SIDECAR}") and not name.startswith("."):
                yield Path(parent, name)


def values_at(path: Path) -> dict[str, Any] | None:
    """Return the values of a file, or None if it is not a sidecar or cannot be read.

    Raises:
        SidecarError: it was edited, cut off or damaged.
    """
    try:
        return parse_sidecar(read_bytes(path), path)
    except OSError:
        return None


def write_sidecar(path: Path, record: Mapping[str, Any]) -> None:
    """Write the sidecar of a picture whose files have been written.

    Raises:
        ImageError: it cannot be written.
    """
    write_atomic(path, sidecar_bytes(record))
    sync_folder(path.parent)


def remove_sidecar(path: Path) -> None:
    """Remove a sidecar, if there is one, before its pictures are written.

    Raises:
        ImageError: it cannot be removed.
    """
    try:
        path.unlink()
        sync_folder(path.parent, immediately=True)
    except FileNotFoundError:
        pass
    except OSError as error:
        raise ImageError(f"{path}: this sidecar cannot be removed: {error.strerror}") from None


def output_entries(values: Mapping[str, Any]) -> dict[str, Mapping[str, Any]]:
    """Return the entries of the files that a sidecar lists, by name, with their size and SHA-256.

    An entry without these values, or with a name outside the sidecar's folder, is ignored.
    """
    listed = values.get("outputs")
    return {
        item["name"]: item
        for item in (listed if isinstance(listed, list) else ())
        if isinstance(item, dict) and {"name", "size", "sha256"} <= item.keys()
        if isinstance(item["name"], str) and os.path.basename(item["name"]) == item["name"] != ""
        if "\0" not in item["name"]
    }


def input_entries(
    values: Mapping[str, Any], paths: Sequence[Path]
) -> list[tuple[Path, Mapping[str, Any]]]:
    """Return the input files of a picture, each with its entry in the sidecar.

    They are the files of its image and of its layers. An entry has the size, modification time and
    SHA-256.

    Args:
        values: the values of the sidecar.
        paths: the files of the image.

    Raises:
        KeyError, TypeError, ValueError: the values are damaged, or list another number of files.
    """
    image_entry = {"size": values["input_size"], "modified": values["input_modified"]}
    layers = (*values.get("carried", ()), *values.get("depth", ()), *values.get("flow", ()))
    return [
        *zip(
            paths,
            values.get("subframes", [image_entry | {"sha256": values["sha256"]}]),
            strict=True,
        ),
        *((paths[0].parent / layer["file"], layer) for layer in layers),
    ]


class CachedJson(dict[str, Any]):
    """A dictionary that many records share, and that is encoded as JSON only once.

    >>> CachedJson(a=1).text
    '{"a": 1}'
    """

    @cached_property
    def text(self) -> str:
        """The JSON text."""
        return to_json(self)


def _text_of(value: Any) -> str:
    return value.text if isinstance(value, CachedJson) else to_json(value)


def json_text(record: Mapping[str, Any]) -> str:
    """Return a record as JSON, with one line for each key and for each object in a list.

    >>> print(json_text({"a": 1, "b": [{"c": 2}, {"d": [3, 4]}]}), end="")
    {
      "a": 1,
      "b": [
        {"c": 2},
        {"d": [3, 4]}
      ]
    }
    """
    lines = []
    for key, value in record.items():
        if isinstance(value, list) and value and isinstance(value[0], dict):
            items = ",\n".join(f"    {_text_of(item)}" for item in value)
            text = f"[\n{items}\n  ]"
        else:
            text = _text_of(value)
        lines.append(f'  "{key}": {text}')  # keys are names, without characters to escape
    return "{\n" + ",\n".join(lines) + "\n}\n"


def _digest_lines(head: bytes) -> bytes:
    """Return the last two lines of a sidecar, from the bytes before them."""
    return f'  "{DIGEST_KEY}": "{hashlib.sha256(head).hexdigest()}"\n}}\n'.encode()
