"""File names in settings: the parameters that hold them, and the directory to resolve them in."""

from collections.abc import Mapping
from functools import cache
from pathlib import Path
from typing import Any

from clpipe.chain.methods import base_name
from clpipe.chain.registry import all_stages
from clpipe.stage import Stage


def resolve_paths(folder: Path, values: Mapping[str, Any]) -> dict[str, Any]:
    """Return nested values with file names joined to the directory that they are relative to."""
    resolved = dict(values)
    for key, value in values.items():
        stage = all_stages().get(base_name(key))
        if key == "camera":
            resolved[key] = join_path(folder, value, only=".toml")
        elif isinstance(value, Mapping) and stage:
            files = file_parameters(stage)
            resolved[key] = {n: join_path(folder, v) if n in files else v for n, v in value.items()}
    return resolved


@cache
def file_parameters(stage: Stage) -> frozenset[str]:
    """Return the parameters of a stage's methods that hold a file name."""
    fields = [field for method in stage.methods for field in method.model_fields.items()]
    extras: dict[str, Any] = {name: field.json_schema_extra for name, field in fields}
    return frozenset(name for name, extra in extras.items() if extra["file"])


def join_path(folder: Path, value: Any, only: str = "") -> Any:
    """Return a file name, or a draw among file names, joined to a directory; else the value.

    >>> join_path(Path("a"), {"choice": ["b.toml", "sony-a7r2"]}, only=".toml")
    {'choice': ['a/b.toml', 'sony-a7r2']}
    """
    if isinstance(value, Mapping) and isinstance(value.get("choice"), list):
        return {**value, "choice": [join_path(folder, one, only) for one in value["choice"]]}
    is_name = isinstance(value, str) and value and value.endswith(only)
    return str(folder / value) if is_name else value
