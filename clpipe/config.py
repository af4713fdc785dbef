"""From a TOML file and the command line to a validated chain of stages."""

import re
import tomllib
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from pydantic import ValidationError

from clpipe.camera import Camera, load_camera
from clpipe.errors import RequestError
from clpipe.stage import Context, Kind, Method, Stage
from clpipe.stages import DEFAULT_CHAIN, all_stages
from clpipe.suggest import one_of

KEYS = ("camera", "iso", "seed", "stages", "skip")


@dataclass(frozen=True)
class Settings:
    """A request as it was written, names checked but nothing resolved yet."""

    camera: str = "sony-a7r2"
    iso: float = 100.0
    seed: int = 0
    stages: tuple[str, ...] = DEFAULT_CHAIN
    skip: tuple[str, ...] = ()
    parameters: Mapping[str, Mapping[str, Any]] = field(default_factory=dict)


@dataclass(frozen=True)
class Step:
    """A stage in its place in a chain: its method with resolved parameters, and what is known."""

    name: str
    stage: Stage
    method: Method
    context: Context


@dataclass(frozen=True)
class Chain:
    """A chain of stages, ready to plan."""

    steps: tuple[Step, ...]
    source: Kind
    camera: Camera
    iso: float
    seed: int

    @property
    def result(self) -> Kind:
        """The kind of image that comes out."""
        return self.steps[-1].stage.writes if self.steps else self.source

    def step_named(self, name: str) -> Step:
        """The step of that name.

        Raises:
            RequestError: the chain has no such step.
        """
        for step in self.steps:
            if step.name == name:
                return step
        raise RequestError(one_of("stage in this chain", name, [s.name for s in self.steps]))


def read_settings(path: Path) -> Settings:
    """Settings from a TOML file.

    Raises:
        RequestError: the file cannot be read, is not TOML, or names what there is not; the message
            gives the file and, where there is one, the line.
    """
    try:
        text = path.read_text("utf-8-sig")
        return settings_from(tomllib.loads(text))
    except OSError as error:
        raise RequestError(f"{path}: cannot read this configuration: {error.strerror}") from None
    except UnicodeDecodeError:
        raise RequestError(f"{path}: not a text file, so not a TOML configuration") from None
    except tomllib.TOMLDecodeError as error:
        raise RequestError(f"{path}: not valid TOML: {error}") from None
    except KeyedError as error:
        line = line_of(text, error.key)
        place = f"{path}, line {line}" if line else str(path)
        raise RequestError(f"{place}: {error}") from None


class KeyedError(RequestError):
    """A bad setting; ``key`` is its dotted name."""

    def __init__(self, key: str, message: str) -> None:
        super().__init__(message)
        self.key = key


def line_of(text: str, key: str) -> int | None:
    """The line of a TOML text (from 1) on which a key such as ``stage.parameter`` is set."""
    table = ""
    header = None
    for number, line in enumerate(text.splitlines(), 1):
        if match := re.match(r"\s*\[\s*([\w.-]+)\s*\]", line):
            table = match[1] + "."
            if match[1] == key:
                header = number
        elif (match := re.match(r"\s*([\w.-]+)\s*=", line)) and table + match[1] == key:
            return number
    return header


def settings_from(values: Mapping[str, Any]) -> Settings:
    """Settings from nested values as a TOML file holds them, every name and parameter checked.

    Raises:
        KeyedError: an unknown key, stage, method or parameter, or a value of the wrong type or out
            of range.
    """
    tables = {key: value for key, value in values.items() if isinstance(value, Mapping)}
    plain = {key: value for key, value in values.items() if key not in tables}
    for key in plain:
        if key in all_stages():
            raise KeyedError(key, f"{key}: found {plain[key]!r}, but a stage is a table: [{key}]")
        if key not in KEYS:
            raise KeyedError(key, one_of("key", key, (*KEYS, *all_stages())))
    for key, expected in (("camera", str), ("iso", (int, float)), ("seed", int)):
        value = plain.get(key)
        if key in plain and (not isinstance(value, expected) or isinstance(value, bool)):
            kinds = {"camera": "text", "iso": "a number", "seed": "a whole number"}
            raise KeyedError(key, f"{key}: found {value!r}, but it is {kinds[key]}")
    for key in ("stages", "skip"):
        names = plain.get(key, [])
        if not isinstance(names, Sequence) or isinstance(names, str):
            raise KeyedError(key, f"{key}: found {names!r}, but it is a list of stage names")
        for name in names:
            stage_named(key, str(name))
        plain[key] = tuple(names) if key in plain else DEFAULT_CHAIN if key == "stages" else ()
    for name, table in tables.items():
        stage = stage_named(name, re.sub(r"_\d+$", "", name))
        make_method(stage, name, table)
    if "iso" in plain:
        plain["iso"] = float(plain["iso"])
    return Settings(parameters=tables, **plain)


def stage_named(key: str, name: str) -> Stage:
    """The stage of that name.

    Raises:
        KeyedError: there is no such stage.
    """
    if name not in all_stages():
        raise KeyedError(key, one_of("stage", name, all_stages()))
    return all_stages()[name]


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
    try:
        value = tomllib.loads(f"value = {match[3]}")["value"]
    except tomllib.TOMLDecodeError:
        value = match[3]
    return match[1], match[2], value


def method_of(name: str, table: Mapping[str, Any]) -> Any:
    """The method that a step's settings choose: the one they name, or the stage's default."""
    stage = all_stages().get(re.sub(r"_\d+$", "", name))
    return table.get("method", stage.methods[0].method if stage else None)


def make_method(stage: Stage, name: str, table: Mapping[str, Any]) -> Method:
    """A stage's method from its settings, parameters validated.

    Raises:
        KeyedError: an unknown method or parameter, or a value that is not allowed.
    """
    chosen = table.get("method", stage.methods[0].method)
    if not isinstance(chosen, str) or chosen not in stage.by_name:
        message = one_of("method", str(chosen), stage.by_name)
        raise KeyedError(f"{name}.method", f"{name}.method: {message}")
    method = stage.by_name[chosen]
    with named_errors(name, method):
        return method.model_validate({k: v for k, v in table.items() if k != "method"})


@contextmanager
def named_errors(name: str, method: type[Method]) -> Iterator[None]:
    """Turn what pydantic says of a step's parameters into a message that names the step.

    Raises:
        KeyedError: a parameter is unknown, or its value is not allowed.
    """
    try:
        yield
    except ValidationError as errors:
        error = errors.errors()[0]
        key = ".".join([name, *(str(part) for part in error["loc"])])
        if error["type"] == "extra_forbidden":
            what = f"parameter of {name} ({method.method})"
            raise KeyedError(
                key, one_of(what, str(error["loc"][0]), ["method", *method.model_fields])
            ) from None
        reason = error["msg"].removeprefix("Value error, ").removeprefix("Input ")
        found = f" found {error['input']!r}:" if error["loc"] else ""
        raise KeyedError(key, f"{key}:{found} {reason}") from None


def make_chain(settings: Settings, source: Kind = Kind.RGB) -> Chain:
    """The chain that the settings ask for, every parameter resolved.

    A stage that comes a second time is called ``stage_2``, and so on.

    Raises:
        RequestError: a chain whose image kinds do not fit, an unknown camera, an ISO it has not.
    """
    camera = load_camera(settings.camera)
    camera.noise(settings.iso)  # refuses an ISO that the camera has not
    context = Context(camera=camera, iso=settings.iso)
    steps: list[Step] = []
    kind = source
    before = "the input"
    for stage_name in settings.stages:
        if stage_name in settings.skip:
            continue
        stage = all_stages()[stage_name]
        count = 1 + sum(step.stage is stage for step in steps)
        name = stage_name if count == 1 else f"{stage_name}_{count}"
        if stage.reads is not kind:
            raise RequestError(misfit(name, stage, before, kind))
        method = make_method(stage, name, settings.parameters.get(name, {}))
        with named_errors(name, type(method)):
            method = method.resolve(context)
        steps.append(Step(name, stage, method, context))
        context = method.after(context)
        kind, before = stage.writes, name
    if not steps:
        raise RequestError("stages: nothing is left to do; every stage was skipped")
    names = [step.name for step in steps]
    for name in settings.parameters:
        if name not in names and name not in all_stages():
            raise KeyedError(name, one_of("stage in this chain", name, names))
    return Chain(tuple(steps), source, camera, settings.iso, settings.seed)


def misfit(name: str, stage: Stage, before: str, kind: Kind) -> str:
    """Why a stage cannot follow, and which stages could stand between."""
    bridges = [s.name for s in all_stages().values() if (s.reads, s.writes) == (kind, stage.reads)]
    help_ = f"put {' or '.join(bridges)} between them" if bridges else f"leave out {name} as well"
    return f"stage {name} reads {stage.reads.label}, but {before} gives {kind.label}; {help_}"
