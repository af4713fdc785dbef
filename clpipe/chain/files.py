"""Configurations: TOML files in, and a chain as such a file out."""

import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from importlib import resources
from itertools import pairwise
from pathlib import Path
from typing import Any

from clpipe.base.errors import KeyedError, RequestError
from clpipe.base.reading import check_exists, parse_toml, read_text
from clpipe.base.text import one_of
from clpipe.chain.chain import Chain, Step
from clpipe.chain.keys import CODE, KEYS, LENS, TABLES, names_in
from clpipe.chain.looks import laid_over
from clpipe.chain.paths import from_folder
from clpipe.chain.registry import load_stage_file
from clpipe.chain.settings import Settings, settings_from
from clpipe.chain.toml import line_of, value_text


def built_in_configs() -> dict[str, Path]:
    """The configurations inside the package, by name."""
    folder = Path(str(resources.files("clpipe.chain") / "configs"))
    return {path.stem: path for path in sorted(folder.glob("*.toml"))}


@dataclass(frozen=True)
class Config:
    """A configuration: its values, nested as in its file, and the settings that they come to.

    Names of files in it are absolute, or relative to the working directory. Its stage files stand
    apart: whoever names a configuration trusts them, and no other values load code.
    """

    values: Mapping[str, Any]
    settings: Settings
    stage_files: tuple[Path, ...]


def load_settings(*names: str) -> Settings:
    """The settings of configurations, or the default ones; errors as :func:`load_configs`."""
    return load_configs(names).settings if names else Settings()


def load_configs(names: Sequence[str]) -> Config:
    """Configurations, each laid over those before it, see :func:`clpipe.chain.looks.laid_over`.

    Args:
        names: at least one, as for :func:`load_config`.

    Raises:
        RequestError: as :func:`load_config`, or one cannot be laid over those before it.
    """
    found = load_config(names[0])
    for before, name in pairwise(names):
        over = load_config(name)
        try:
            settings = laid_over(found.settings, over.values)
        except KeyedError as error:
            raise RequestError(f"{name} over {before}: {error}") from None
        named = found.values.keys() | over.values.keys()
        record = settings.record()
        own = {key: v for key, v in record.items() if key in named or isinstance(v, Mapping)}
        code = dict.fromkeys((*found.stage_files, *over.stage_files))
        found = Config(own, settings, tuple(code))
    return found


def load_config(name: str) -> Config:
    """A configuration, validated.

    Args:
        name: of a built-in configuration, or the path of a file (ending in .toml).

    Raises:
        RequestError: there is no such configuration or file, it cannot be read, is not TOML, or
            holds a name or value that is not allowed; the message gives the file and, where there
            is one, the line.
    """
    built_in = built_in_configs()
    path = built_in.get(name, Path(name))
    if path.suffix != ".toml" and not os.path.isfile(path):
        raise RequestError(one_of("configuration", name, built_in) + ", or a .toml file")
    check_exists(path)
    try:
        text = read_text(path)
        values = parse_toml(text)
    except OSError as error:
        raise RequestError(f"{path}: cannot read this configuration: {error.strerror}") from None
    except UnicodeDecodeError:
        raise RequestError(f"{path}: not a text file, so not a TOML configuration") from None
    except ValueError as error:
        raise RequestError(f"{path}: not valid TOML: {error}") from None
    try:
        stage_files = [path.parent / file for file in names_in(values, CODE, "files")]
        for file in stage_files:
            load_stage_file(file)
        values.pop(CODE, None)
        settings = settings_from(values, path.parent)
    except KeyedError as error:
        line = line_of(text, error.key)
        place = f"{path}, line {line}" if line else str(path)
        raise RequestError(f"{place}: {error}") from None
    record = settings.record()
    own = {key: record[key] for key in values if key in record}
    return Config(own, settings, tuple(file.resolve() for file in stage_files))


def toml_text(chain: Chain) -> str:
    """A chain as a configuration with every parameter.

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
    for name, table in _other_tables(chain, draws).items():
        if table:
            lines += ["", f"[{name}]", *(f"{k} = {value_text(v)}" for k, v in table.items())]
    return "\n".join(lines) + "\n"


def config_text(values: Mapping[str, Any], stage_files: Sequence[Path] = ()) -> str:
    """Nested values as the text of a configuration; names of files become absolute.

    Args:
        values: as :class:`Config` has them.
        stage_files: that it loads.

    >>> print(config_text({"iso": 800.0, "denoise": {"method": "mean"}, "skip": ["gamma"]}), end="")
    iso = 800
    skip = ["gamma"]
    <BLANKLINE>
    [denoise]
    method = "mean"
    """
    values = from_folder(Path.cwd(), values)
    code = {CODE: [str(file.resolve()) for file in stage_files]} if stage_files else {}
    is_table = {key: isinstance(v, Mapping) and key not in KEYS for key, v in values.items()}
    plain = {key: value for key, value in values.items() if not is_table[key]}
    lines = [f"{key} = {value_text(value)}" for key, value in (code | plain).items()]
    for name, table in values.items():
        if is_table[name] and table:
            lines += ["", f"[{name}]", *(f"{k} = {value_text(v)}" for k, v in table.items())]
    return "\n".join(lines) + "\n"


def _step_lines(step: Step, settings: Settings, draws: Mapping[str, Any]) -> list[str]:
    """The method and the parameters of a step, a line each."""
    shown = step.method
    if not isinstance(shown, type(settings.method(step.name))):  # another has taken its place
        shown = settings.method(step.name)
    method = draws.get(f"{step.name}.method", shown.method)
    constants = settings.parameters.get(step.name, {})
    lines = [f"method = {value_text(method)}"]
    for name, field in type(shown).model_fields.items():
        extra: Any = field.json_schema_extra
        value = draws.get(f"{step.name}.{name}", getattr(shown, name))
        if value is None or (name not in constants and isinstance(method, Mapping)):
            continue  # other methods than the one in the example may not have it
        line = f"{name} = {value_text(value)}"
        if name not in constants and field.default is None:
            line = f"# {line}  # automatic: {extra['auto']}"
        elif extra["unit"]:
            line += f"  # {extra['unit']}"
        lines.append(line)
    return lines


def _other_tables(chain: Chain, draws: Mapping[str, Any]) -> dict[str, dict[str, Any]]:
    """The tables that belong to no step of a chain, and what a draw may follow."""
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
