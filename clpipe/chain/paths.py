"""TODO."""

from collections.abc import Mapping
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

from clpipe.chain.methods import base_name, stage_named
from clpipe.chain.registry import all_stages
from clpipe.stage import Stage

if TYPE_CHECKING:
    from clpipe.chain.settings import Settings


def from_folder(folder: Path, values: Mapping[str, Any]) -> dict[str, Any]:
    """Settings as :func:`settings_from` takes them, with names of files relative to the folder no
    more.
    """
    found = dict(values)
    for key, value in values.items():
        stage = all_stages().get(base_name(key))
        if key == "camera":
            found[key] = joined(folder, value, only=".toml")
        elif isinstance(value, Mapping) and stage:
            files = file_parameters(stage)
            found[key] = {n: joined(folder, v) if n in files else v for n, v in value.items()}
    return found


@cache
def file_parameters(stage: Stage) -> frozenset[str]:
    """The parameters of a stage's methods that are names of files."""
    fields = [field_ for method in stage.methods for field_ in method.model_fields.items()]
    extras: dict[str, Any] = {name: field_.json_schema_extra for name, field_ in fields}
    return frozenset(name for name, extra in extras.items() if extra["file"])


def joined(folder: Path, value: Any, only: str = "") -> Any:
    """The name of a file in a folder, or a draw of such; other values as they are.

    >>> joined(Path("a"), {"choice": ["b.toml", "sony-a7r2"]}, only=".toml")
    {'choice': ['a/b.toml', 'sony-a7r2']}
    """
    if isinstance(value, Mapping) and isinstance(value.get("choice"), list):
        return {**value, "choice": [joined(folder, one, only) for one in value["choice"]]}
    named = isinstance(value, str) and value and value.endswith(only)
    return str(folder / value) if named else value


def files_of(settings: "Settings") -> list[str]:
    """The files that settings name, whose contents so are a part of them."""
    files = [settings.camera] if settings.camera.endswith(".toml") else []
    for name, table in settings.parameters.items():
        stage = stage_named(name, base_name(name))
        method = stage.by_name.get(str(table.get("method", stage.methods[0].method)))
        for parameter, field_ in (method.model_fields if method else {}).items():
            extra: Any = field_.json_schema_extra
            if extra["file"] and isinstance(value := table.get(parameter), str) and value:
                files.append(value)
    return files
