"""Read configurations from TOML files, and write a chain as such a file."""

import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from importlib import resources
from itertools import pairwise
from pathlib import Path
from typing import Any

from clpipe.base.errors import KeyedError, RequestError
from clpipe.base.reading import check_exists, parse_toml, read_text
from clpipe.base.text import unknown_name
from clpipe.base.url_text import local_path
from clpipe.chain.chain import Chain, Step
from clpipe.chain.keys import CODE, KEYS, LENS, TABLES, string_list
from clpipe.chain.looks import override_settings
from clpipe.chain.paths import resolve_paths
from clpipe.chain.registry import load_stage_file
from clpipe.chain.settings import Settings, settings_from
from clpipe.chain.toml import line_of, value_text


def built_in_configs() -> dict[str, Path]:
    """Return the paths of the configurations inside the package, by name."""
    folder = Path(str(resources.files("clpipe.chain") / "configs"))
    return {path.stem: path for path in sorted(folder.glob("*.toml"))}


@dataclass(frozen=True)
class Config:
    """A configuration: its values, nested as in its file, and the settings that result from them.

    File names in it are absolute, or relative to the working directory. Its stage files are kept
    apart from its values: you trust the code of a configuration that you name, and no other values
    load code.
    """

    values: Mapping[str, Any]
    settings: Settings
    stage_files: tuple[Path, ...]


def load_settings(*names: str) -> Settings:
    """Return the settings of configurations; the defaults if none is named.

    Raises the errors of :func:`load_configs`.
    """
    return load_configs(names).settings if names else Settings()


def load_configs(names: Sequence[str]) -> Config:
    """Load configurations, each of which overrides those before it.

    See :func:`clpipe.chain.looks.override_settings`.

    Args:
        names: at least one name, as for :func:`load_config`.

    Raises:
        RequestError: as :func:`load_config`, or if one cannot override those before it.
    """
    combined = load_config(names[0])
    for before, name in pairwise(names):
        override = load_config(name)
        try:
            settings = override_settings(combined.settings, override.values)
        except KeyedError as error:
            raise RequestError(f"{name} over {before}: {error}") from None
        named = combined.values.keys() | override.values.keys()
        record = settings.record()
        values = {key: v for key, v in record.items() if key in named or isinstance(v, Mapping)}
        code = dict.fromkeys((*combined.stage_files, *override.stage_files))
        combined = Config(values, settings, tuple(code))
    return combined


def load_config(name: str) -> Config:
    """Load a configuration and validate it.

    Args:
        name: the name of a built-in configuration, or the path of a .toml file.

    Raises:
        RequestError: the configuration does not exist, cannot be read, is not TOML, or contains a
            name or value that is not allowed. The message names the file and, if known, the line.
    """
    built_in = built_in_configs()
    path = built_in.get(name) or local_path("config", name)
    if path.suffix != ".toml" and not os.path.isfile(path):
        raise RequestError(unknown_name("configuration", name, built_in) + ", or a .toml file")
    check_exists(path)
    try:
        text = read_text(path)
        values = parse_toml(text)
    except OSError as error:
        raise RequestError(f"{path}: cannot read the configuration: {error.strerror}") from None
    except UnicodeDecodeError:
        raise RequestError(
            f"{path}: this is not a text file; a configuration is a TOML file in UTF-8"
        ) from None
    except ValueError as error:
        raise RequestError(f"{path}: the configuration is not valid TOML: {error}") from None
    try:
        stage_files = [
            path.parent / local_path(CODE, file) for file in string_list(values, CODE, "files")
        ]
        for file in stage_files:
            load_stage_file(file)
        values.pop(CODE, None)
        settings = settings_from(values, path.parent)
    except KeyedError as error:
        line = line_of(text, error.key)
        location = f"{path}, line {line}" if line else str(path)
        raise RequestError(f"{location}: {error}") from None
    record = settings.record()
    set_values = {key: record[key] for key in values if key in record}
    return Config(set_values, settings, tuple(file.resolve() for file in stage_files))


def toml_text(chain: Chain) -> str:
    """Return a chain as the text of a configuration with every parameter.

    Values that follow from the camera or the ISO are comments, and draws are printed as draws.
    """
    settings = chain.settings
    draws = {key: draw.record() for key, draw in chain.draws.items()}
    lines = [
        f"camera = {value_text(draws.get('camera', settings.camera))}",
        f"iso = {value_text(draws.get('iso', settings.iso))}",
        *(f"{key} = {value_text(v)}" for key, v in settings.record().items() if key in LENS),
        f"seed = {value_text(settings.seed)}",
        *([f"dump = {value_text(settings.dump)}"] if settings.dump else []),
        "stages = [",
        *(f"    {value_text(step.stage.name)}," for step in chain.steps),
        "]",
    ]
    for step in chain.steps:
        lines += ["", f"[{step.name}]", *_step_lines(step, settings, draws)]
    return "\n".join([*lines, *_table_lines(_other_tables(chain, draws))]) + "\n"


def config_text(values: Mapping[str, Any], stage_files: Sequence[Path] = ()) -> str:
    """Return nested values as the text of a configuration. File names become absolute.

    Args:
        values: nested values, as in :class:`Config`.
        stage_files: the stage files that the configuration loads.

    >>> print(config_text({"iso": 800.0, "denoise": {"method": "mean"}, "skip": ["gamma"]}), end="")
    iso = 800
    skip = ["gamma"]
    <BLANKLINE>
    [denoise]
    method = "mean"
    """
    values = resolve_paths(Path.cwd(), values)
    code = {CODE: [str(file.resolve()) for file in stage_files]} if stage_files else {}
    tables = {k: v for k, v in values.items() if isinstance(v, Mapping) and k not in KEYS}
    plain = {key: value for key, value in values.items() if key not in tables}
    lines = [f"{key} = {value_text(value)}" for key, value in (code | plain).items()]
    return "\n".join([*lines, *_table_lines(tables)]) + "\n"


def _table_lines(tables: Mapping[str, Mapping[str, Any]]) -> list[str]:
    """Return the lines of tables that are not empty."""
    lines: list[str] = []
    for name, table in tables.items():
        if table:
            lines += ["", f"[{name}]", *(f"{k} = {value_text(v)}" for k, v in table.items())]
    return lines


def _step_lines(step: Step, settings: Settings, draws: Mapping[str, Any]) -> list[str]:
    """Return the method and the parameters of a step, one per line."""
    shown = step.method
    if not isinstance(shown, type(settings.method(step.name))):  # another method replaced it
        shown = settings.method(step.name)
    method = draws.get(f"{step.name}.method", shown.method)
    constants = settings.parameters.get(step.name, {})
    lines = [f"method = {value_text(method)}"]
    for name, field in type(shown).model_fields.items():
        extra: Any = field.json_schema_extra
        value = draws.get(f"{step.name}.{name}", getattr(shown, name))
        if value is None or (name not in constants and isinstance(method, Mapping)):
            continue  # methods other than the one in the example may not have this parameter
        line = f"{name} = {value_text(value)}"
        if name not in constants and field.default is None:
            line = f"# {line}  # automatic: {extra['auto']}"
        elif extra["unit"]:
            line += f"  # {extra['unit']}"
        lines.append(line)
    return lines


def _other_tables(chain: Chain, draws: Mapping[str, Any]) -> dict[str, dict[str, Any]]:
    """Return the tables that belong to no step of a chain, and values that a draw may follow."""
    settings = chain.settings
    record = settings.record()
    tables = {name: dict(record.get(name, {})) for name in TABLES}
    if draws:
        steps = {step.name for step in chain.steps}
        tables |= {k: dict(t) for k, t in settings.parameters.items() if k not in steps}
    for key, draw in draws.items():
        table, _, name = key.partition(".")
        if table in tables:
            tables[table][name] = draw
    return tables
