"""File names in settings: the parameters that hold them, and the directory to resolve them in."""

from collections.abc import Mapping
from functools import cache
from pathlib import Path
from typing import Any

from clpipe.base.errors import RequestError
from clpipe.base.url_text import local
from clpipe.chain.keys import RENDER, setting_error
from clpipe.chain.methods import base_name
from clpipe.chain.registry import all_stages
from clpipe.stage import Stage


def resolve_paths(folder: Path | None, values: Mapping[str, Any]) -> dict[str, Any]:
    """Return nested values with file names joined to the directory that they are relative to.

    ``file:`` URLs become paths. If the directory is None, other file names stay the same.

    Raises:
        KeyedError: a ``file:`` URL has no absolute path, or names another machine.
    """
    resolved = dict(values)
    for key, value in values.items():
        stage = all_stages().get(base_name(key))
        if key == "camera":
            resolved[key] = _joined(folder, key, value, only=".toml")
        elif key == RENDER and isinstance(value, Mapping) and "illuminant" in value:
            file = _joined(folder, f"{RENDER}.illuminant", value["illuminant"], only=".csv")
            resolved[key] = {**value, "illuminant": file}
        elif isinstance(value, Mapping) and stage:
            files = file_parameters(stage)
            resolved[key] = {
                n: _joined(folder, f"{key}.{n}", v) if n in files else v for n, v in value.items()
            }
    return resolved


@cache
def file_parameters(stage: Stage) -> frozenset[str]:
    """Return the parameters of a stage's methods that hold a file name."""
    fields = [field for method in stage.methods for field in method.model_fields.items()]
    extras: dict[str, Any] = {name: field.json_schema_extra for name, field in fields}
    return frozenset(name for name, extra in extras.items() if extra["file"])


def _joined(folder: Path | None, key: str, value: Any, only: str = "") -> Any:
    """Return :func:`join_path` of the value of a key.

    Raises:
        KeyedError: a ``file:`` URL is wrong.
    """
    try:
        return join_path(folder, value, only)
    except RequestError as error:
        raise setting_error(f"{key}: {error}") from None


def join_path(folder: Path | None, value: Any, only: str = "") -> Any:
    """Return a file name, or a draw among file names, joined to a directory; else the value.

    Raises:
        RequestError: a ``file:`` URL has no absolute path, or names another machine.

    >>> join_path(Path("a"), {"choice": ["b.toml", "sony-a7r2"]}, only=".toml")
    {'choice': ['a/b.toml', 'sony-a7r2']}
    """
    if isinstance(value, Mapping) and isinstance(value.get("choice"), list):
        return {**value, "choice": [join_path(folder, one, only) for one in value["choice"]]}
    if not isinstance(value, str) or not value.endswith(only) or not value:
        return value
    value = local(value)
    return str(folder / value) if folder else value
