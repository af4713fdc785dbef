"""From a TOML file and the command line to a validated chain of stages."""

import re
import tomllib
from collections.abc import Container, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from functools import cache, lru_cache, partial
from importlib import resources
from itertools import product
from pathlib import Path
from typing import Any

from pydantic import BaseModel, ValidationError

from clpipe.camera import DEFAULT_CAMERA, Camera, load_camera
from clpipe.draws import (
    TINY,
    Choice,
    Draw,
    Limits,
    extremes_of,
    limits_of,
    parse_draw,
    values_of,
)
from clpipe.errors import KeyedError, RequestError
from clpipe.noise_model import NoiseModel
from clpipe.output import Output
from clpipe.raw_dump import Dump, dump_of
from clpipe.registry import all_stages, blamed, check_passes, load_stage_file
from clpipe.stage import Context, Kind, Method, Noiseless, Stage, Unchanged
from clpipe.stages import DEFAULT_CHAIN
from clpipe.suggest import one_of

OUTPUT = "output"  # the table that is no stage's
MOST_ISO = 10**9
DRAWN = ("iso", "camera")  # what can be, beside parameters
KEYS = ("camera", "iso", "seed", "raw_size", "raw_type", "stages", "skip", "stage_files")


@dataclass(frozen=True)
class Settings:
    """A request as it was written, names checked but nothing resolved yet.

    Where ``draws`` has a law for something ("iso", "sensor_noise.a"), its value is still to come.
    """

    camera: str = DEFAULT_CAMERA
    iso: float = 100.0
    seed: int = 0
    raw_size: str = ""  # of headerless dumps: WIDTHxHEIGHT
    raw_type: str = ""  # and how their samples are stored
    stages: tuple[str, ...] = DEFAULT_CHAIN
    skip: tuple[str, ...] = ()
    parameters: Mapping[str, Mapping[str, Any]] = field(default_factory=dict)
    output: Output = field(default_factory=Output)
    draws: Mapping[str, Draw] = field(default_factory=dict)

    def record(self) -> dict[str, Any]:
        """The settings as nested values, from which :func:`settings_from` makes them again."""
        return self._record({key: draw.record() for key, draw in self.draws.items()})

    def drawn(self, image_key: str) -> "Settings":
        """The settings with a value for each draw; the same object where there are none.

        The values depend on the seed and the image key alone (see :mod:`clpipe.draws`). Frames of a
        burst share the key, and so the values, of their image.

        Raises:
            RequestError: the values are not allowed together, or a camera cannot be loaded.
        """
        if not self.draws:
            return self
        limits = partial(limits_at, self, isos=isos_of(self) if "iso" in self.draws else Limits())
        owner = f"draw:{self.seed}:{image_key}"
        return settings_from(self._record(values_of(self.draws, self.given(), limits, owner)))

    def given(self) -> dict[str, Any]:
        """What has a value already, by its dotted name."""
        tables = {**self.parameters, OUTPUT: self.output.model_dump(exclude_defaults=True)}
        named = {f"{name}.{key}": v for name, table in tables.items() for key, v in table.items()}
        return {"iso": self.iso, "camera": self.camera, **named}

    def table(self, step: str) -> dict[str, Any]:
        """The values and draws of a step, or of the output."""
        output = self.output.model_dump(exclude_defaults=True) if step == OUTPUT else {}
        names = {key: key.removeprefix(f"{step}.") for key in self.draws}
        drawn = {names[key]: draw for key, draw in self.draws.items() if names[key] != key}
        return {**self.parameters.get(step, output), **drawn}

    def _record(self, drawn: Mapping[str, Any]) -> dict[str, Any]:
        """The settings as nested values, with others over them by their dotted names."""
        plain: dict[str, Any] = {"camera": self.camera, "iso": self.iso, "seed": self.seed}
        if self.dump:
            plain |= {"raw_size": self.raw_size, "raw_type": self.raw_type}
        lists = {"stages": list(self.stages), "skip": list(self.skip)}
        output = self.output.model_dump(exclude_defaults=True)
        tables = {**self.parameters, **({OUTPUT: output} if output else {})}
        record = {**plain, **lists, **{name: dict(t) for name, t in tables.items()}}
        for key, value in drawn.items():
            table, _, name = key.rpartition(".")
            (record.setdefault(table, {}) if table else record)[name] = value
        return record

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
    draws: Mapping[str, Draw] = field(default_factory=dict)  # of which the settings are an example

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


def settings_from(values: Mapping[str, Any], folder: Path | None = None) -> Settings:
    """Settings from nested values as a TOML file holds them, every name and parameter checked.

    Args:
        values: a dict of the file's form.
        folder: what the names of files are relative to; None is the working directory.

    Raises:
        KeyedError: an unknown key, stage, method or parameter, or a value of the wrong type or out
            of range.
    """
    return overlay(Settings(), values, folder)


def overlay(settings: Settings, values: Mapping[str, Any], folder: Path | None = None) -> Settings:
    """The settings with others over them; what is to be skipped is added to what was.

    Where another method is chosen for a step, the parameters of the one before are dropped. A value
    takes the place of a draw, and the other way round.

    Args:
        settings: what holds where nothing else is said.
        values: as for :func:`settings_from`.
        folder: as for :func:`settings_from`.

    Raises:
        KeyedError: as :func:`settings_from`.
    """
    for path in names_in(values, "stage_files", "files"):
        load_stage_file((folder or Path()) / path)
    if folder is not None:
        values = from_folder(folder, values)
    tables = {key: value for key, value in values.items() if isinstance(value, Mapping)}
    plain = {k: v for k, v in values.items() if k not in tables and k != "stage_files"}
    for key in plain:
        if key in all_stages():
            raise KeyedError(key, f"{key}: found {plain[key]!r}, but a stage is a table: [{key}]")
        if key == OUTPUT:
            raise KeyedError(key, f"{key}: found {plain[key]!r}, but it is a table: [{key}]")
        if key not in KEYS:
            raise KeyedError(key, one_of("key", key, (*KEYS, OUTPUT, *all_stages())))
        check_type(key, plain[key])
    for key in {"stages", "skip"} & plain.keys():
        names = names_in(plain, key, "stage names")
        for name in names:
            stage_named(key, name if key == "stages" else base_name(name))
        plain[key] = (*settings.skip, *names) if key == "skip" else names
    if "iso" in plain:
        plain["iso"] = float(plain["iso"])
    if {"raw_size", "raw_type"} & plain.keys():
        size = plain.get("raw_size", settings.raw_size)
        try:
            dump_of(size, plain.get("raw_type", settings.raw_type))
        except RequestError as error:
            raise KeyedError(str(error).partition(":")[0], str(error)) from None
    draws = {k: draw for k, draw in settings.draws.items() if k.partition(".")[0] not in values}
    draws |= {key: draw_of(key, tables.pop(key)) for key in KEYS if key in tables}
    parameters, output = dict(settings.parameters), settings.output
    for name, table in tables.items():
        stage = None if name == OUTPUT else stage_named(name, base_name(name))
        said = {
            k: draw_of(f"{name}.{k}", v) if isinstance(v, Mapping) else v for k, v in table.items()
        }
        merged = settings.table(name)
        if "method" in said and said["method"] != method_of(name, merged):
            merged = {}
        merged |= said
        drawn = {f"{name}.{k}": v for k, v in merged.items() if isinstance(v, Draw)}
        draws |= drawn
        given = {k: v for k, v in merged.items() if not isinstance(v, Draw)}
        if stage is None:
            output = make_output(given)
            continue
        parameters[name] = given
        if not drawn:
            make_method(stage, name, given)
    made = replace(settings, parameters=parameters, output=output, draws=draws, **plain)
    if draws:
        check_draws(made, values)
    return made


def check_type(key: str, value: Any) -> None:
    """See that a key that stands in no table has a value of its type.

    Raises:
        KeyedError: it has not.
    """
    types: dict[str, tuple[str, Any]] = {
        "iso": ("a number", int | float),
        "seed": ("a whole number", int),
        **dict.fromkeys(("camera", "raw_size", "raw_type"), ("text", str)),
    }
    kind, expected = types.get(key, ("", object))
    if not isinstance(value, expected) or isinstance(value, bool):
        raise KeyedError(key, f"{key}: found {value!r}, but it is {kind}")
    if key == "iso" and value > MOST_ISO:
        raise KeyedError(key, f"{key}: found {value!r}, but it is at most {MOST_ISO:g}")


def draw_of(key: str, table: Mapping[str, Any]) -> Draw:
    """The draw that stands in the place of a value.

    Raises:
        KeyedError: it is none, or not for such a value.
    """
    if key in KEYS and key not in DRAWN:
        drawn = f"{', '.join(DRAWN)} and the parameters of stages can"
        raise KeyedError(key, f"{key}: found {dict(table)!r}, but it cannot be drawn; {drawn}")
    draw = parse_draw(key, table)
    if (key == "camera" or key.endswith(".method")) and not isinstance(draw, Choice):
        raise KeyedError(key, f"{key}: found {dict(table)!r}, but it is drawn by choice")
    return draw


def models_at(settings: Settings, step: str) -> list[type[BaseModel]]:
    """What declares the parameters of a step: its method, or all that its method is drawn from.

    Raises:
        KeyedError: there is no such method.
    """
    if step == OUTPUT:
        return [Output]
    draw = settings.draws.get(f"{step}.method")
    table = settings.parameters.get(step, {})
    names = draw.choice if isinstance(draw, Choice) else [method_of(step, table)]
    return [method_named(stage_named(step, base_name(step)), step, name) for name in names]


def limits_at(settings: Settings, key: str, isos: Limits) -> Limits | None:
    """The limits of what may be drawn, by its dotted name; those of the ISO are given."""
    step, _, name = key.partition(".")
    if key in ("iso", "camera") or name == "method":
        return isos if key == "iso" else None
    return limits_of(models_at(settings, step)[0], name)


def check_draws(settings: Settings, changed: Container[str]) -> None:
    """See that all that can be drawn is allowed, each with the others at one of their extremes.

    Args:
        settings: with draws.
        changed: the keys and steps that are new; others were checked before. What follows something
            is checked again.

    Raises:
        KeyedError: it is not.
    """
    by_step: dict[str, dict[str, Sequence[Any]]] = {}
    steps = {key.partition(".")[0] for key, draw in settings.draws.items() if draw.of}
    for key in settings.draws:
        step, _, name = key.partition(".")
        for model in models_at(settings, step) if name and step in changed else ():
            if name not in ("method", *model.model_fields):
                raise unknown_parameter(step, model, name)
    limits = partial(limits_at, settings, isos=Limits(low=TINY))
    for key, values in extremes_of(settings.draws, settings.given(), limits).items():
        step, _, name = key.partition(".")
        if not name:
            for value in values:
                check_type(key, value)
        elif step in changed or step in steps:
            by_step.setdefault(step, {})[name] = values
    for step, drawn in by_step.items():
        given = {k: v for k, v in settings.table(step).items() if not isinstance(v, Draw)}
        first = {name: values[0] for name, values in drawn.items()}
        methods = [{"method": method} for method in drawn.pop("method", ())] or [{}]
        others = [{name: value} for name, values in drawn.items() for value in values] or [{}]
        for method, other in product(methods, others):
            table = {**given, **first, **method, **other}
            if step == OUTPUT:
                make_output(table)
            else:
                make_method(stage_named(step, base_name(step)), step, table)


def cameras_of(settings: Settings) -> list[str]:
    """The cameras that there can be."""
    draw = settings.draws.get("camera")
    return list(draw.choice) if isinstance(draw, Choice) else [settings.camera]


def isos_of(settings: Settings) -> Limits:
    """The ISOs that all these cameras have.

    Raises:
        RequestError: a camera cannot be loaded.
    """
    ranges = [load_camera(name).iso_range for name in cameras_of(settings)]
    return Limits(max(low for low, _ in ranges), min(high for _, high in ranges))


def check_camera(settings: Settings) -> None:
    """See that every camera that there can be is there, and has every ISO that there can be.

    Raises:
        RequestError: one is not, or has not.
    """
    isos: Sequence[float] = [settings.iso]
    if "iso" in settings.draws:
        limits = partial(limits_at, settings, isos=isos_of(settings))
        isos = extremes_of(settings.draws, settings.given(), limits)["iso"]
    for camera, iso in product(map(load_camera, cameras_of(settings)), isos):
        camera.gain_stage(iso)


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


@lru_cache(maxsize=1024)
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


def method_of(name: str, table: Mapping[str, Any]) -> Any:
    """The method that a step's settings choose: the one they name, or the stage's default."""
    stage = all_stages().get(base_name(name))
    return table.get("method", stage.methods[0].method if stage else None)


def make_method(stage: Stage, name: str, table: Mapping[str, Any]) -> Method:
    """A stage's method from its settings, parameters validated.

    Raises:
        KeyedError: an unknown method or parameter, or a value that is not allowed.
    """
    method = method_named(stage, name, table.get("method", stage.methods[0].method))
    with named_errors(name, method):
        return method.model_validate({k: v for k, v in table.items() if k != "method"})


def method_named(stage: Stage, name: str, chosen: Any) -> type[Method]:
    """The method of a step's stage that has that name.

    Raises:
        KeyedError: there is none.
    """
    if not isinstance(chosen, str) or chosen not in stage.by_name:
        message = one_of("method", str(chosen), stage.by_name)
        raise KeyedError(f"{name}.method", f"{name}.method: {message}")
    return stage.by_name[chosen]


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
            raise unknown_parameter(OUTPUT, Output, name) from None
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
            raise unknown_parameter(name, method, str(error["loc"][0])) from None
        reason = error["msg"].removeprefix("Value error, ").removeprefix("Input ")
        found = f" found {error['input']!r}:" if error["loc"] else ""
        raise KeyedError(key, f"{key}:{found} {reason}") from None


def unknown_parameter(step: str, model: type[BaseModel], parameter: str) -> KeyedError:
    """What to say of a parameter that a step, or the table of output, has not."""
    key = f"{step}.{parameter}"
    if not issubclass(model, Method):
        return KeyedError(key, one_of(f"key of {step}", parameter, model.model_fields))
    what = f"parameter of {step} ({model.method})"
    message = one_of(what, parameter, ["method", *model.model_fields])
    stage = all_stages()[base_name(step)]
    having = [m for m, other in stage.by_name.items() if parameter in other.model_fields]
    if having:
        message += f"; '{parameter}' is a parameter of {' and '.join(having)}"
    return KeyedError(key, message)


def make_chain(
    settings: Settings,
    source: Kind | None = None,
    start_at: str | None = None,
    until: str | None = None,
) -> Chain:
    """The chain that the settings ask for, every parameter resolved.

    A stage that comes a second time is called ``stage_2``, and so on. Settings with draws give an
    example, that of the image key "", once it is seen that all that can be drawn is right; the
    chain of an image is made of its :meth:`Settings.drawn`.

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
    check_camera(settings)
    draws, settings = settings.draws, settings.drawn("")
    camera = load_camera(settings.camera)
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
    return Chain(tuple(steps[first:last]), source, camera, settings, tuple(names), draws)


def entry(settings: Settings) -> Kind:
    """What enters a whole chain: linear RGB, or a finished picture where the first stage reads it.

    >>> entry(Settings(stages=("inverse_gamma", "mosaic"))).label, entry(Settings()).label
    ('display', 'rgb')
    """
    stages = (all_stages().get(base_name(name)) for name in settings.stages)
    first = next((s for s in stages if s and s.name not in settings.skip), None)
    return Kind.DISPLAY if first and first.reads is Kind.DISPLAY else Kind.RGB


def step_names(settings: Settings) -> list[str]:
    """The names of the steps that are not skipped; that of a repeated one has its number.

    >>> step_names(Settings(stages=("exposure", "mosaic", "exposure"), skip=("mosaic",)))
    ['exposure', 'exposure_2']
    """
    before = [settings.stages[:place].count(stage) for place, stage in enumerate(settings.stages)]
    pairs = zip(settings.stages, before, strict=True)
    names = [f"{stage}_{count + 1}" if count else stage for stage, count in pairs]
    return [name for name in names if name not in settings.skip]


def resolved_steps(settings: Settings, camera: Camera, kind: Kind | None) -> list[Step]:
    """The steps of the settings, in order, for an image of a kind; None is what the first reads.

    A step that does nothing is left out where it does not fit.

    Raises:
        RequestError: image kinds do not fit.
    """
    context = Context(camera=camera, iso=settings.iso)
    steps: list[Step] = []
    before = "the input"
    for name in step_names(settings):
        stage = all_stages()[base_name(name)]
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
