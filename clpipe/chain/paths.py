"""File names in settings: the parameters that hold them, and the directory to resolve them in."""

from collections.abc import Mapping
from functools import cache
from pathlib import Path
from typing import Any

from clpipe.chain.methods import base_name
from clpipe.chain.registry import all_stages
from clpipe.stage import Stage


def from_folder(folder: Path, values: Mapping[str, Any]) -> dict[str, Any]:
    """Return nested values with file names joined to the directory that they are relative to."""
    moved = dict(values)
    for key, value in values.items():
        stage = all_stages().get(base_name(key))
        if key == "camera":
            moved[key] = joined(folder, value, only=".toml")
        elif isinstance(value, Mapping) and stage:
            files = file_parameters(stage)
            moved[key] = {n: joined(folder, v) if n in files else v for n, v in value.items()}
    return moved


@cache
def file_parameters(stage: Stage) -> frozenset[str]:
    """Return the parameters of a stage's methods that hold a file name."""
    fields = [field for method in stage.methods for field in method.model_fields.items()]
    extras: dict[str, Any] = {name: field.json_schema_extra for name, field in fields}
    return frozenset(name for name, extra in extras.items() if extra["file"])


def joined(folder: Path, value: Any, only: str = "") -> Any:
    """Return a file name, or a draw among file names, joined to a directory; else the value.

    >>> joined(Path("a"), {"choice": ["b.toml", "sony-a7r2"]}, only=".toml")
    {'choice': ['a/b.toml', 'sony-a7r2']}
    """
    if isinstance(value, Mapping) and isinstance(value.get("choice"), list):
        return {**value, "choice": [joined(folder, one, only) for one in value["choice"]]}
    is_name = isinstance(value, str) and value and value.endswith(only)
    return str(folder / value) if is_name else value
