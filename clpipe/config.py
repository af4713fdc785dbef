"""From a TOML file and the command line to a validated chain of stages."""

import re
import tomllib
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from importlib import resources
from pathlib import Path
from typing import Any

from pydantic import ValidationError

from clpipe.camera import DEFAULT_CAMERA, Camera, load_camera
from clpipe.errors import RequestError
from clpipe.noise_model import NoiseModel
from clpipe.output import Output
from clpipe.raw_dump import Dump, dump_of
from clpipe.registry import all_stages, blamed, check_passes, load_stage_file
from clpipe.stage import Context, Kind, Method, Noiseless, Stage, Unchanged
from clpipe.stages import DEFAULT_CHAIN
from clpipe.suggest import one_of

OUTPUT = "output"  # the table that is no stage's
KEYS = ("camera", "iso", "seed", "raw_size", "raw_type", "stages", "skip", "stage_files")


@dataclass(frozen=True)
class Settings:
    """A request as it was written, names checked but nothing resolved yet."""

    camera: str = DEFAULT_CAMERA
    iso: float = 100.0
    seed: int = 0
    raw_size: str = ""  # of headerless dumps: WIDTHxHEIGHT
    raw_type: str = ""  # and how their samples are stored
    stages: tuple[str, ...] = DEFAULT_CHAIN
    skip: tuple[str, ...] = ()
    parameters: Mapping[str, Mapping[str, Any]] = field(default_factory=dict)
    output: Output = field(default_factory=Output)

    def record(self) -> dict[str, Any]:
        """The settings as nested values, from which :func:`settings_from` makes them again."""
        plain: dict[str, Any] = {"camera": self.camera, "iso": self.iso, "seed": self.seed}
        if self.dump:
            plain |= {"raw_size": self.raw_size, "raw_type": self.raw_type}
        lists = {"stages": list(self.stages), "skip": list(self.skip)}
        output = self.output.model_dump(exclude_defaults=True)
        tables = {**self.parameters, **({OUTPUT: output} if output else {})}
        return {**plain, **lists, **{name: dict(t) for name, t in tables.items()}}

    @property
    def dump(self) -> Dump | None:
        """The geometry of headerless dumps, where it is given.

        Raises:
            RequestError: it is given in part, or is not allowed.
        """
        given = self.raw_size or self.raw_type
        return dump_of(self.raw_size, self.raw_type) if given else None


@dataclass(frozen=True)
class Step:
    """A stage in its place in a chain: its method with resolved parameters, and what is known."""

    name: str
    stage: Stage
    method: Method
    context: Context


@dataclass(frozen=True, eq=False)
class Chain:
    """A chain of stages, ready to plan. One is equal to itself alone, so what is made of it can be
    remembered.
    """

    steps: tuple[Step, ...]
    source: Kind
    camera: Camera
    settings: Settings  # it was made from
    names: tuple[str, ...]  # of all steps, those before the first and after the last to run too

    @property
    def iso(self) -> float:
        """The ISO."""
        return self.settings.iso

    @property
    def seed(self) -> int:
        """The seed of the noise."""
        return self.settings.seed

    @property
    def result(self) -> Kind:
        """The kind of image that comes out."""
        return self.steps[-1].stage.writes if self.steps else self.source

    @property
    def noise(self) -> NoiseModel | None:
        """The sensor noise in the image that comes out; None where none was added."""
        last = self.steps[-1]
        return last.method.after(last.context).noise

    @property
    def is_noisy(self) -> bool:
        """Whether a step draws random numbers."""
        return any(p.random for s in self.steps for p in s.method.passes())

    def clean(self) -> "Chain":
        """The chain without what its steps draw at random; all else as it is, the last step too.

        Raises:
            RequestError: no step draws anything.
        """
        left = [(step, step.method.clean()) for step in self.steps]
        if all(method is step.method for step, method in left):
            raise RequestError(
                "no stage of this chain adds noise; every frame would be the same, "
                "and there is no noise to know the truth of"
            )
        if left[-1][1] is None:
            left[-1] = left[-1][0], Noiseless()
        steps = tuple(
            replace(step, method=method, context=replace(step.context, noise=None))
            for step, method in left
            if method
        )
        return replace(self, steps=steps)

    def kept(self, names: Sequence[str]) -> tuple[str, ...]:
        """The names of steps to keep, each once; ``all`` is every one.

        Raises:
            RequestError: the chain has no such step.
        """
        if "all" in names:
            return tuple(step.name for step in self.steps)
        return tuple(self.step_named(name).name for name in dict.fromkeys(names))

    def through(self, names: Sequence[str]) -> "Chain":
        """The chain up to the last of these steps; all of it where none is named."""
        places = [place for place, step in enumerate(self.steps) if step.name in names]
        return replace(self, steps=self.steps[: places[-1] + 1]) if places else self

    def step_named(self, name: str) -> Step:
        """The step of that name.

        Raises:
            RequestError: the chain has no such step.
        """
        for step in self.steps:
            if step.name == name:
                return step
        raise RequestError(one_of("stage in this chain", name, [s.name for s in self.steps]))


def built_in_configs() -> dict[str, Path]:
    """The configurations inside the package, by name."""
    folder = Path(str(resources.files("clpipe") / "configs"))
    return {path.stem: path for path in sorted(folder.glob("*.toml"))}


def load_settings(name: str, under: Settings = Settings()) -> Settings:
    """A built-in configuration by its name, or a file by its path (ending in .toml).

    ``under`` are the settings that hold where it says nothing.

    Raises:
        RequestError: there is no such configuration or file, or it is not valid.
    """
    return overlay(under, own_values(name))


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
    except tomllib.TOMLDecodeError as error:
        raise RequestError(f"{path}: not valid TOML: {error}") from None
    except KeyedError as error:
        line = line_of(text, error.key)
        place = f"{path}, line {line}" if line else str(path)
        raise RequestError(f"{place}: {error}") from None
    said = {key: own[key] for key in values if key in own}
    if files := values.get("stage_files"):
        said["stage_files"] = [str((path.parent / file).resolve()) for file in files]
    return said


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


def settings_from(values: Mapping[str, Any], folder: Path | None = None) -> Settings:
    """Settings from nested values as a TOML file holds them, every name and parameter checked.

    Args:
        values: a dict of the file's form.
        folder: what the names of files are relative to; None is the working directory.

    Raises:
        KeyedError: an unknown key, stage, method or parameter, or a value of the wrong type or out
            of range.
    """
    folder = folder or Path()
    tables = {key: value for key, value in values.items() if isinstance(value, Mapping)}
    output = make_output(tables.pop(OUTPUT, {}))
    plain = {key: value for key, value in values.items() if not isinstance(value, Mapping)}
    for path in names_in(plain, "stage_files", "files"):
        load_stage_file(folder / path)
    plain.pop("stage_files", None)
    for key in plain:
        if key in all_stages():
            raise KeyedError(key, f"{key}: found {plain[key]!r}, but a stage is a table: [{key}]")
        if key == OUTPUT:
            raise KeyedError(key, f"{key}: found {plain[key]!r}, but it is a table: [{key}]")
        if key not in KEYS:
            raise KeyedError(key, one_of("key", key, (*KEYS, OUTPUT, *all_stages())))
    texts = dict.fromkeys(("camera", "raw_size", "raw_type"), str)
    types: dict[str, Any] = {**texts, "iso": (int, float), "seed": int}
    for key, expected in types.items():
        value = plain.get(key)
        if key in plain and (not isinstance(value, expected) or isinstance(value, bool)):
            kind = {"iso": "a number", "seed": "a whole number"}.get(key, "text")
            raise KeyedError(key, f"{key}: found {value!r}, but it is {kind}")
    for key in {"stages", "skip"} & plain.keys():
        names = names_in(plain, key, "stage names")
        for name in names:
            stage_named(key, name if key == "stages" else base_name(name))
        plain[key] = names
    for name, table in tables.items():
        stage = stage_named(name, base_name(name))
        tables[name] = from_folder(folder, stage, table)
        make_method(stage, name, tables[name])
    if "iso" in plain:
        plain["iso"] = float(plain["iso"])
    if str(plain.get("camera", "")).endswith(".toml"):
        plain["camera"] = str(folder / plain["camera"])
    if {"raw_size", "raw_type"} & plain.keys():
        try:
            dump_of(plain.get("raw_size", ""), plain.get("raw_type", ""))
        except RequestError as error:
            raise KeyedError(str(error).partition(":")[0], str(error)) from None
    return Settings(parameters=tables, output=output, **plain)


def overlay(settings: Settings, values: Mapping[str, Any]) -> Settings:
    """The settings with others over them; what is to be skipped is added to what was.

    Where another method is chosen for a step, the parameters of the one before are dropped.

    Args:
        settings: what holds where nothing else is said.
        values: as for :func:`settings_from`.

    Raises:
        KeyedError: as :func:`settings_from`.
    """
    merged = settings.record()
    for key, value in values.items():
        if isinstance(value, Mapping):
            old = dict(merged.get(key, {}))
            if "method" in value and value["method"] != method_of(key, old):
                old.clear()
            merged[key] = old | dict(value)
        elif key == "skip" and isinstance(value, Sequence) and not isinstance(value, str):
            merged[key] = [*merged[key], *value]
        else:
            merged[key] = value
    return settings_from(merged)


def names_in(values: Mapping[str, Any], key: str, what: str) -> tuple[str, ...]:
    """The list of texts under a key; empty if it is not there.

    Raises:
        KeyedError: it is something else.
    """
    names = values.get(key, [])
    if isinstance(names, str | Mapping) or not isinstance(names, Sequence):
        raise KeyedError(key, f"{key}: found {names!r}, but it is a list of {what}")
    for name in names:
        if not isinstance(name, str):
            raise KeyedError(key, f"{key}: found {name!r} in the list, but it is one of {what}")
    return tuple(names)


def from_folder(folder: Path, stage: Stage, table: Mapping[str, Any]) -> dict[str, Any]:
    """A step's settings, in which the names of files are relative to the folder no more."""
    method = stage.by_name.get(str(table.get("method", stage.methods[0].method)))
    values = dict(table)
    for name, field_ in (method.model_fields if method else {}).items():
        extra: Any = field_.json_schema_extra
        if extra["file"] and isinstance(values.get(name), str):
            values[name] = str(folder / values[name]) if values[name] else ""
    return values


def files_of(settings: Settings) -> list[str]:
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


def base_name(step: str) -> str:
    """The stage of a step that may be a repeated one.

    >>> base_name("denoise_2")
    'denoise'
    """
    return re.sub(r"_\d+$", "", step)


def stage_named(key: str, name: str) -> Stage:
    """The stage of that name.

    Raises:
        KeyedError: there is no such stage.
    """
    if name not in all_stages():
        if base_name(name) in all_stages():
            again = f"{name}: a stage that is to come again is listed again, as {base_name(name)}"
            raise KeyedError(key, f"{again}; the second is then called {base_name(name)}_2")
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
    stage = all_stages().get(base_name(name))
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


def make_output(table: Mapping[str, Any]) -> Output:
    """How results are written, from the table of that name.

    Raises:
        KeyedError: an unknown key, or a value that is not allowed.
    """
    try:
        return Output.model_validate(dict(table))
    except ValidationError as errors:
        error = errors.errors()[0]
        name = str(error["loc"][0])
        key = f"{OUTPUT}.{name}"
        if error["type"] == "extra_forbidden":
            raise KeyedError(key, one_of("key of output", name, Output.model_fields)) from None
        reason = error["msg"].removeprefix("Input ")
        raise KeyedError(key, f"{key}: found {error['input']!r}: {reason}") from None


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
            parameter = str(error["loc"][0])
            message = one_of(what, parameter, ["method", *method.model_fields])
            stage = all_stages()[base_name(name)]
            having = [m for m, other in stage.by_name.items() if parameter in other.model_fields]
            if having:
                message += f"; '{parameter}' is a parameter of {' and '.join(having)}"
            raise KeyedError(key, message) from None
        reason = error["msg"].removeprefix("Value error, ").removeprefix("Input ")
        found = f" found {error['input']!r}:" if error["loc"] else ""
        raise KeyedError(key, f"{key}:{found} {reason}") from None


def make_chain(
    settings: Settings,
    source: Kind | None = None,
    start_at: str | None = None,
    until: str | None = None,
) -> Chain:
    """The chain that the settings ask for, every parameter resolved.

    A stage that comes a second time is called ``stage_2``, and so on.

    Args:
        settings: the request.
        source: the kind of image that enters; None is what :func:`entry` says, or, with
            ``start_at``, what that step reads.
        start_at: the first step to run. The steps before it are resolved all the same: what they
            say of the image (pattern, gains, noise, levels) holds.
        until: the last step to run.

    Raises:
        RequestError: a chain whose image kinds do not fit, an unknown camera, an ISO it has not,
            a step that is not there.
    """
    camera = load_camera(settings.camera)
    camera.noise(settings.iso)  # refuses an ISO that the camera has not
    steps = resolved_steps(settings, camera, source or (None if start_at else entry(settings)))
    names = [step.name for step in steps]
    for name in settings.parameters:
        if name not in names and name not in all_stages():
            raise KeyedError(name, one_of("stage in this chain", name, names))
    first, last = 0, len(steps)
    for name in (n for n in (start_at, until) if n is not None):
        if name not in names:
            raise RequestError(one_of("stage in this chain", name, names))
    if start_at is not None:
        first = names.index(start_at)
    if until is not None:
        last = names.index(until) + 1
    if first >= last:
        raise RequestError(
            f"nothing is left to do; {start_at} comes after {until}"
            if steps
            else "stages: nothing is left to do; no stage is listed, or every one was skipped"
        )
    if source is None:
        source = steps[first].stage.reads
    return Chain(tuple(steps[first:last]), source, camera, settings, tuple(names))


def entry(settings: Settings) -> Kind:
    """What enters a whole chain: linear RGB, or a finished picture where the first stage reads it.

    >>> entry(Settings(stages=("inverse_gamma", "mosaic"))).label, entry(Settings()).label
    ('display', 'rgb')
    """
    stages = (all_stages().get(base_name(name)) for name in settings.stages)
    first = next((s for s in stages if s and s.name not in settings.skip), None)
    return Kind.DISPLAY if first and first.reads is Kind.DISPLAY else Kind.RGB


def resolved_steps(settings: Settings, camera: Camera, kind: Kind | None) -> list[Step]:
    """The steps of the settings, in order, for an image of a kind; None is what the first reads.

    A step that does nothing is left out where it does not fit.

    Raises:
        RequestError: image kinds do not fit.
    """
    context = Context(camera=camera, iso=settings.iso)
    steps: list[Step] = []
    count: dict[str, int] = {}
    before = "the input"
    for stage_name in settings.stages:
        stage = all_stages()[stage_name]
        count[stage_name] = count.get(stage_name, 0) + 1
        name = stage_name if count[stage_name] == 1 else f"{stage_name}_{count[stage_name]}"
        if name in settings.skip:
            continue
        method = make_method(stage, name, settings.parameters.get(name, {}))
        if stage.reads is not (kind or stage.reads):
            if isinstance(method, Unchanged) and stage.reads is stage.writes:
                continue  # so that gamma can be skipped without picture_noise, which does nothing
            raise RequestError(misfit(name, stage, before, kind or stage.reads))
        with named_errors(name, type(method)), blamed(f"stage {name}", stage.folder):
            method = method.resolve(context)
            after = method.after(context)
        if stage.folder:
            check_passes(name, stage, method, context)
        steps.append(Step(name, stage, method, context))
        context = after
        kind, before = stage.writes, name
    return steps


def misfit(name: str, stage: Stage, before: str, kind: Kind) -> str:
    """Why a stage cannot follow, and which stages could stand between."""
    bridges = [s.name for s in all_stages().values() if (s.reads, s.writes) == (kind, stage.reads)]
    help_ = f"put {' or '.join(bridges)} between them" if bridges else f"leave out {name} as well"
    if before == "the input":
        help_ += f", or enter there with an image of that kind: --start-at {name}"
    return f"stage {name} reads {stage.reads.label}, but {before} gives {kind.label}; {help_}"
