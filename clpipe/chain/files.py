"""TODO."""

import json
import re
import tomllib
from collections.abc import Mapping
from importlib import resources
from pathlib import Path
from typing import Any

from clpipe.base.errors import KeyedError, RequestError
from clpipe.base.text import one_of
from clpipe.chain.chain import Chain
from clpipe.chain.keys import OUTPUT
from clpipe.chain.settings import Settings, overlay, settings_from


def built_in_configs() -> dict[str, Path]:
    """The configurations inside the package, by name."""
    folder = Path(str(resources.files("clpipe.chain") / "configs"))
    return {path.stem: path for path in sorted(folder.glob("*.toml"))}


def load_settings(name: str) -> Settings:
    """A built-in configuration by its name, or a file by its path (ending in .toml).

    Raises:
        RequestError: there is no such configuration or file, or it is not valid.
    """
    return overlay(Settings(), own_values(name))


def own_values(name: str) -> dict[str, Any]:
    """What a configuration says, nested as in its file. Files that it names are relative to it.

    Args:
        name: of a built-in configuration, or the path of a file (ending in .toml).

    Raises:
        RequestError: there is no such configuration or file, it cannot be read, is not TOML, or
            names what there is not; the message gives the file and, where there is one, the line.
    """
    built_in = built_in_configs()
    path = built_in.get(name, Path(name))
    if path.suffix != ".toml" and not path.is_file():
        raise RequestError(one_of("configuration", name, built_in) + ", or a .toml file")
    try:
        text = path.read_text("utf-8-sig")
        values = tomllib.loads(text)
        own = settings_from(values, path.parent).record()
    except OSError as error:
        raise RequestError(f"{path}: cannot read this configuration: {error.strerror}") from None
    except UnicodeDecodeError:
        raise RequestError(f"{path}: not a text file, so not a TOML configuration") from None
    except (ValueError, RecursionError) as error:  # tomllib's, of numbers and lists without end too
        raise RequestError(f"{path}: not valid TOML: {error}") from None
    except KeyedError as error:
        line = line_of(text, error.key)
        place = f"{path}, line {line}" if line else str(path)
        raise RequestError(f"{place}: {error}") from None
    said = {key: own[key] for key in values if key in own}
    if files := values.get("stage_files"):
        said["stage_files"] = [str((path.parent / file).resolve()) for file in files]
    return said


def line_of(text: str, key: str) -> int | None:
    """The line of a TOML text (from 1) on which a key such as ``stage.parameter`` is set."""
    table = ""
    within = None
    for number, line in enumerate(text.splitlines(), 1):
        if match := re.match(r"\s*\[\s*([\w.-]+)\s*\]", line):
            name, table = match[1], match[1] + "."
        elif match := re.match(r"\s*([\w.-]+)\s*=", line):
            name = table + match[1]
            if name == key:
                return number
        else:
            continue
        if within is None and f"{name}.".startswith(f"{key}."):
            within = number
    return within


def parse_assignment(text: str) -> tuple[str, str, Any]:
    """``stage.parameter=value`` as its three parts; the value as TOML, or text if it is no TOML.

    >>> parse_assignment("sensor_noise.a=1e-4")
    ('sensor_noise', 'a', 0.0001)

    Raises:
        RequestError: the text does not have that form.
    """
    match = re.fullmatch(r"(\w+)\.(\w+)=(.*)", text)
    if not match:
        raise RequestError(f"--set {text}: expected stage.parameter=value")
    return match[1], match[2], toml_value(match[3])


def toml_value(text: str) -> Any:
    """What a text is as a TOML value; the text itself if it is none.

    >>> toml_value("1e-4"), toml_value("{choice = [100, 400]}"), toml_value("bilinear")
    (0.0001, {'choice': [100, 400]}, 'bilinear')
    """
    try:
        found = tomllib.loads(f"value = {text}")
    except (ValueError, RecursionError):
        return text
    return found["value"] if len(found) == 1 else text


def value_text(value: Any) -> str:
    """A parameter's value, as TOML has it.

    >>> value_text((1.0, 2.5)), value_text("bayer"), value_text(False)
    ('[1, 2.5]', '"bayer"', 'false')
    >>> value_text({"uniform": [1, 2]})
    '{ uniform = [1, 2] }'
    """
    if isinstance(value, Mapping):
        return f"{{ {', '.join(f'{key} = {value_text(v)}' for key, v in value.items())} }}"
    if isinstance(value, list | tuple):
        return f"[{', '.join(map(value_text, value))}]"
    if isinstance(value, float):
        return repr(int(value)) if value.is_integer() and abs(value) < 1e15 else repr(value)
    return json.dumps(value, ensure_ascii=False)


def toml_text(chain: Chain) -> str:
    """A chain as a configuration, complete: what follows camera and ISO is there as a comment, what
    is drawn as its draw.
    """
    settings = chain.settings
    draws = {key: draw.record() for key, draw in chain.draws.items()}
    lines = [
        f"camera = {value_text(draws.get('camera', settings.camera))}",
        f"iso = {value_text(draws.get('iso', settings.iso))}",
        f"seed = {value_text(settings.seed)}",
        *(f"{key} = {value_text(v)}" for key, v in settings.record().items() if key[:4] == "raw_"),
        "stages = [",
        *(f"    {value_text(step.stage.name)}," for step in chain.steps),
        "]",
    ]
    for step in chain.steps:
        method = draws.get(f"{step.name}.method", step.method.method)
        lines += ["", f"[{step.name}]", f"method = {value_text(method)}"]
        given = settings.parameters.get(step.name, {})
        for name, field in type(step.method).model_fields.items():
            extra: Any = field.json_schema_extra
            value = draws.get(f"{step.name}.{name}", getattr(step.method, name))
            if value is None or (name not in given and isinstance(method, Mapping)):
                continue  # other methods than the one in the example may not have it
            line = f"{name} = {value_text(value)}"
            if name not in given and field.default is None:
                line = f"# {line}  # automatic: {extra['auto']}"
            lines.append(
                line + (f"  # {extra['unit']}" if extra["unit"] and line[0] != "#" else "")
            )
    tables = {OUTPUT: settings.output.model_dump(exclude_defaults=True)}
    if draws:  # which may follow what stands elsewhere
        ran = {step.name for step in chain.steps}
        tables |= {k: dict(t) for k, t in settings.parameters.items() if k not in ran}
    for key, draw in draws.items():
        table, _, name = key.partition(".")
        if table in tables:
            tables[table][name] = draw
    for name, table_ in tables.items():
        if table_:
            lines += ["", f"[{name}]", *(f"{k} = {value_text(v)}" for k, v in table_.items())]
    return "\n".join(lines) + "\n"
