"""Settings: every value that is set, checked by name and range, and every draw.

Nothing here depends on the camera's data or on a stage's place in the chain. These are resolved in
:mod:`clpipe.chain.making`.
"""

from collections.abc import Callable, Container, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any

from pydantic import BaseModel

from clpipe.base.errors import KeyedError, RequestError
from clpipe.base.text import quote_alternatives, unknown_name
from clpipe.base.tracing import with_changes
from clpipe.camera.control import Control
from clpipe.camera.profile import Camera, built_in_name, load_camera
from clpipe.chain.drawing import (
    draw_extremes,
    draw_values,
    examples_of,
    parse_drawn,
    with_iso_range,
)
from clpipe.chain.draws import Choice, Draw
from clpipe.chain.keys import (
    CODE,
    KEYS,
    LENS,
    MAX_STAGES,
    TABLES,
    PlainSettings,
    check_type,
    set_dotted,
    setting_error,
    string_list,
)
from clpipe.chain.lens_presets import PRESETS, with_preset, without_preset
from clpipe.chain.limits import SMALLEST_FLOAT, Limits, field_limits
from clpipe.chain.methods import (
    TABLE_MODELS,
    check_step,
    make_model,
    method_name,
    method_named,
    parameter_names,
    stage_of,
    step_names,
    unknown_parameter,
)
from clpipe.chain.paths import file_parameters, resolve_paths
from clpipe.chain.registry import all_stages, stage_in
from clpipe.chain.render_camera import RenderCamera
from clpipe.images.dump import Dump, parse_dump
from clpipe.images.encoding import Encoding
from clpipe.stage import Method, StageRole


@dataclass(frozen=True)
class Settings(PlainSettings):
    """Values that can be set. Nothing is resolved yet: None and missing values are automatic.

    The values in ``draws``, by dotted name ("sensor_noise.a"), are drawn by :meth:`drawn`.
    """

    parameters: Mapping[str, Mapping[str, Any]] = field(default_factory=dict)
    output: Encoding = field(default_factory=Encoding)
    render: RenderCamera = field(default_factory=RenderCamera)
    control: Control = field(default_factory=Control)
    pushed: bool = False  # the ISO was drawn, and may be outside the camera's range
    draws: Mapping[str, Draw] = field(default_factory=dict)
    # By step: the validated table and the resulting model.
    validated: Mapping[str, tuple[Mapping[str, Any], Method]] = field(
        default_factory=dict, compare=False, repr=False
    )

    @property
    def label(self) -> str:
        """The camera and the ISO as text for people."""
        camera = "drawn camera" if "camera" in self.draws else self.camera
        return f"{camera}, {'drawn ISO' if 'iso' in self.draws else f'ISO {self.iso:g}'}"

    def record(self) -> dict[str, Any]:
        """Return the settings as nested JSON values, which :func:`settings_from` reads back."""
        plain: dict[str, Any] = {"camera": self.camera, "iso": self.iso, "seed": self.seed}
        named = *LENS, "noise_key", "dump"
        plain |= {key: value for key in named if (value := getattr(self, key))}
        lists = {"stages": list(self.stages), "skip": list(self.skip)}
        record = {**plain, **lists, **{name: dict(table) for name, table in self.tables.items()}}
        for key, draw in self.draws.items():
            set_dotted(record, key, draw.record())
        return record

    def drawn(self, name: str, frame: float = 0) -> "Settings":
        """Return the settings with a value for each draw; the same object if there are no draws.

        The values depend only on the seed and the image's name (see :mod:`clpipe.chain.draws`).
        Frames of a burst share the name, and therefore the values, of their image. For a frame of a
        sequence, ``name`` is the name of the sequence, and ``frame`` its place, on which only
        values that drift depend.

        Raises:
            RequestError: the values are not allowed together, or a camera cannot be loaded.
        """
        if not self.draws:
            return self
        owner = f"draw:{self.seed}:{name}"
        draws, isos = dict(self.draws), Limits()
        if "iso" in draws:
            first = {key: draw for key, draw in draws.items() if key == "camera"}
            limits = partial(self.limits, isos=isos)
            own = draw_values(first, self.constants(), limits, owner).get("camera", self.camera)
            isos = self.drawn_isos(load_camera(own))
            draws["iso"] = draws["iso"].truncated(isos) or draws["iso"]
        limits = partial(self.limits, isos=isos)
        values: dict[str, Any] = {}
        for key, value in draw_values(draws, self.constants(), limits, owner, frame).items():
            step, _, name = key.rpartition(".")
            if step:
                values.setdefault(step, dict(self.parameters.get(step, {})))[name] = value
            else:
                values[name] = value
        pushed = "iso" in self.draws and "camera" not in self.draws
        drawn = overlay(self, values)
        return with_changes(drawn, {"pushed": True}) if pushed else drawn

    def drawn_values(self, name: str, frame: float) -> dict[str, Any]:
        """Return the values of :meth:`drawn` that are drawn, nested like a configuration."""
        drawn = self.drawn(name, frame)
        constants = drawn.constants() if self.draws else {}
        low, high = load_camera(drawn.camera).iso_range
        if drawn.pushed and not low <= drawn.iso <= high:
            constants["iso"] = {"choice": [drawn.iso]}  # only a draw may exceed the range
        values: dict[str, Any] = {}
        for key in self.draws:
            set_dotted(values, key, constants[key])
        return values

    def constants(self) -> dict[str, Any]:
        """Return the values that are set and not drawn, by dotted name."""
        tables = self.tables.items()
        named = {f"{name}.{key}": v for name, table in tables for key, v in table.items()}
        lens = {key: value for key in LENS if (value := getattr(self, key))}
        return {"iso": self.iso, "camera": self.camera, **lens, **named}

    def table(self, step: str) -> dict[str, Any]:
        """Return the values and draws of a step, or of another table."""
        names = {key: key.removeprefix(f"{step}.") for key in self.draws}
        drawn = {names[key]: draw for key, draw in self.draws.items() if names[key] != key}
        return {**self.tables.get(step, {}), **drawn}

    @property
    def tables(self) -> dict[str, Mapping[str, Any]]:
        """The values that are set, by step, and by the tables that belong to no stage."""
        others = {name: getattr(self, name).model_dump(exclude_defaults=True) for name in TABLES}
        return {**self.parameters, **{name: own for name, own in others.items() if own}}

    def method(self, step: str) -> Method:
        """Return the method of a step with its parameters, validated.

        Raises:
            KeyedError: a stage, method or parameter is unknown, or a value is not allowed.
        """
        table = self.parameters.get(step, {})
        validated, model = self.validated.get(step, (None, None))
        if model is None or validated is not table:
            model = make_model(step, table)
        return model

    @property
    def step_names(self) -> tuple[str, ...]:
        """The names of the steps that are not skipped. A repeated stage gets a number.

        The bands of a spectral render are added up first, whether or not that stage is listed.

        >>> Settings(stages=("exposure", "mosaic", "exposure"), skip=("mosaic",)).step_names
        ('exposure', 'exposure_2')
        """
        names = step_names(self.stages, self.skip)
        if not self.render.wavelengths:
            return names
        spectral = stage_in(StageRole.SPECTRUM).name
        return names if spectral in (*self.stages, *self.skip) else (spectral, *names)

    @property
    def named_lens(self) -> str:
        """The name of a lens in lensfun's database; "" without one."""
        return "" if self.lens in PRESETS else self.lens

    @property
    def dump_format(self) -> Dump | None:
        """The format of headerless dumps; None if it is not set."""
        return parse_dump(self.dump) if self.dump else None

    def files(self) -> list[str]:
        """Return the files that the settings name. Their contents are part of the settings."""
        files = [self.camera] if self.camera.endswith(".toml") else []
        files += [self.render.illuminant] if self.render.illuminant.endswith(".csv") else []
        for step, table in self.parameters.items():
            for name in sorted(file_parameters(stage_of(step))):
                if isinstance(value := table.get(name), str) and value:
                    files.append(value)
        return files

    def models(self, step: str) -> list[type[BaseModel]]:
        """Return the classes that declare a step's parameters: its method, or all drawn methods.

        Raises:
            KeyedError: there is no such method.
        """
        if step in TABLE_MODELS:
            return [TABLE_MODELS[step]]
        stage, draw = stage_of(step), self.draws.get(f"{step}.method")
        chosen = method_name(step, self.parameters.get(step, {}))
        names = draw.choice if isinstance(draw, Choice) else [chosen]
        return [method_named(stage, step, name) for name in names]

    def limits(self, key: str, isos: Limits) -> Limits | None:
        """Return the limits of a value by its dotted name; None if it is no number.

        ``isos`` are the limits of "iso".

        Raises:
            KeyedError: its step has no such method.
        """
        step, _, name = key.partition(".")
        if key in LENS:
            return None if key == "lens" else Limits(low=SMALLEST_FLOAT)
        if key in ("iso", "camera") or name == "method":
            return isos if key == "iso" else None
        return field_limits(self.models(step)[0], name)

    def names_of(self, key: str) -> list[str]:
        """Return the names of the camera or lens, or of all that are drawn; [] without a lens."""
        draw, name = self.draws.get(key), getattr(self, key)
        return list(draw.choice) if isinstance(draw, Choice) else [name] * bool(name)

    def isos(self) -> Limits:
        """Return the range of ISOs of the camera; of drawn cameras, the range that all have.

        Raises:
            RequestError: a camera cannot be loaded.
        """
        ranges = [load_camera(name).iso_range for name in self.names_of("camera")]
        return Limits(max(low for low, _ in ranges), min(high for _, high in ranges))

    def drawn_isos(self, camera: Camera) -> Limits:
        """Return the ISOs that can be drawn for a camera. A set camera may be pushed."""
        return Limits(*(camera.iso_range if "camera" in self.draws else camera.pushed_range))


def settings_from(values: Mapping[str, Any], folder: Path | None = None) -> Settings:
    """Return settings from nested values as in a TOML file. Every name and value is checked.

    Args:
        values: nested values of the form of a configuration file.
        folder: the directory that file names are relative to; None is the working directory, and
            ``file:`` URLs are already resolved.

    Raises:
        KeyedError: a key, stage, method or parameter is unknown, or a value has the wrong type or
            is out of range.
    """
    return overlay(Settings(), values, folder)


def overlay(settings: Settings, values: Mapping[str, Any], folder: Path | None = None) -> Settings:
    """Return settings that other values override. Only steps that ``values`` names are validated.

    Stages to skip are added to those that are already skipped. If ``values`` chooses another method
    for a step, the parameters of the earlier method are dropped. A value replaces a draw, and a
    draw replaces a value.

    Args:
        settings: the settings to override.
        values: as for :func:`settings_from`.
        folder: as for :func:`settings_from`.

    Raises:
        KeyedError: as :func:`settings_from`.
    """
    if folder is not None:
        values = resolve_paths(folder, values)
    if "lens" in values and settings.lens in PRESETS:
        settings = _without_lens(settings)
    values = with_iso_range(with_preset(values, settings.stages))
    tables = {key: value for key, value in values.items() if isinstance(value, Mapping)}
    plain = {k: v for k, v in values.items() if k not in tables}
    plain = _check_plain_values(settings, plain)
    draws = {k: draw for k, draw in settings.draws.items() if k.partition(".")[0] not in values}
    draws |= {key: parse_drawn(key, tables.pop(key)) for key in KEYS if key in tables}
    parameters, validated = dict(settings.parameters), dict(settings.validated)
    for step, table in tables.items():
        merged = _merge_table(settings, step, table)
        step_draws = {f"{step}.{k}": v for k, v in merged.items() if isinstance(v, Draw)}
        draws |= step_draws
        constants = {k: v for k, v in merged.items() if not isinstance(v, Draw)}
        if step in TABLES:
            plain[step] = make_model(step, constants)
            continue
        parameters[step] = constants
        if not step_draws:
            validated[step] = constants, make_model(step, constants)
    tables_now = {"parameters": parameters, "validated": validated, "draws": draws}
    changed = with_changes(settings, {**plain, **tables_now})
    if draws:
        _check_draws(changed, values)
    return changed


# Replace a camera's aliases by its name, so that requests can be compared.
CONVERSIONS: dict[str, Callable[[Any], Any]] = {
    **dict.fromkeys(("iso", *LENS[1:]), float),
    "camera": lambda name: built_in_name(name) or name,
}


def _check_plain_values(settings: Settings, plain: Mapping[str, Any]) -> dict[str, Any]:
    """Return the values outside tables, each checked, as fields of :class:`Settings`.

    Raises:
        KeyedError: a key is unknown, or a value is not allowed.
    """
    checked = dict(plain)
    for key, value in plain.items():
        if key in TABLES or key in all_stages():
            entry = (
                f"'method': {value!r}" if key in all_stages() and isinstance(value, str) else "..."
            )
            raise setting_error(
                f"{key}: found {value!r}, but it is a table; in Python use {key}={{{entry}}}, in a "
                f"file [{key}]"
            )
        if key == CODE:
            raise setting_error(f"{key}: set it in a configuration file, or use --stage-file")
        if key not in KEYS:
            similar = [each for each in parameter_names() if each.endswith(f".{key}")]
            hint = f"; did you mean {quote_alternatives(similar)}?" if similar else ""
            raise KeyedError(key, unknown_name("key", key, (*KEYS, *TABLES, *all_stages())) + hint)
        check_type(key, value)
    for key in ("stages", "skip"):
        if key in plain:
            names = string_list(plain, key, "stage names")
            if key == "stages" and len(names) > MAX_STAGES:
                raise setting_error(f"{key}: found {len(names)} stages; list at most {MAX_STAGES}")
            for name in names:
                check_step(key, name)
            checked[key] = (*settings.skip, *names) if key == "skip" else names
    checked |= {key: convert(plain[key]) for key, convert in CONVERSIONS.items() if key in plain}
    if plain.get("dump"):
        try:
            parse_dump(plain["dump"])
        except RequestError as error:
            raise KeyedError("dump", str(error)) from None
    return checked


def _without_lens(settings: Settings) -> Settings:
    """Return settings without the values of a lens that has no name."""
    draws, parameters = dict(settings.draws), dict(settings.parameters)
    for step in PRESETS[settings.lens]:
        own = without_preset(settings.lens, settings.table(step), step)
        parameters[step] = {k: v for k, v in own.items() if not isinstance(v, Draw)}
        for key in [k for k in draws if k.startswith(f"{step}.")]:
            if key.removeprefix(f"{step}.") not in own:
                del draws[key]
    return with_changes(settings, {"lens": "", "parameters": parameters, "draws": draws})


def _merge_table(settings: Settings, step: str, table: Mapping[str, Any]) -> dict[str, Any]:
    """Return the values and draws of a step, overridden by a table.

    Raises:
        KeyedError: there is no such stage, or a table inside the table is no draw.
    """
    methods = () if step in TABLES else stage_of(step).methods
    drawn = {k: parse_drawn(f"{step}.{k}", v) for k, v in table.items() if isinstance(v, Mapping)}
    values = {**table, **drawn}
    existing = settings.table(step)
    if "method" in values and values["method"] != method_name(step, existing):
        return values
    for method in methods:
        if values.keys() & method.alternatives:
            existing = {k: v for k, v in existing.items() if k not in method.alternatives}
    return {**existing, **values}


def _check_draws(settings: Settings, changed: Container[str]) -> None:
    """Check that every value that can be drawn is allowed, by validating the extremes.

    Args:
        settings: settings with draws.
        changed: the keys and steps that are new. The others were checked earlier. A step with a
            draw that follows another value is checked again.

    Raises:
        KeyedError: a draw is for an unknown parameter, or can draw a value that is not allowed.
    """
    followers = {key.partition(".")[0] for key, draw in settings.draws.items() if draw.follows}
    for key in settings.draws:
        step, _, name = key.partition(".")
        for model in settings.models(step) if name and step in changed else ():
            if name not in ("method", *model.model_fields):
                raise unknown_parameter(step, model, name)
    limits = partial(settings.limits, isos=Limits(low=SMALLEST_FLOAT))
    by_step: dict[str, dict[str, Sequence[Any]]] = {}
    for key, extremes in draw_extremes(settings.draws, settings.constants(), limits).items():
        step, _, name = key.partition(".")
        if not name:
            for value in extremes:
                check_type(key, value)
        elif step in changed or step in followers:
            by_step.setdefault(step, {})[name] = extremes
    for step, drawn in by_step.items():
        constants = {k: v for k, v in settings.table(step).items() if not isinstance(v, Draw)}
        for example in examples_of(drawn):
            make_model(step, {**constants, **example})
