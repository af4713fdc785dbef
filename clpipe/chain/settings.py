"""From a TOML file and the command line to a validated chain of stages."""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any

from clpipe.base.errors import KeyedError, RequestError
from clpipe.base.text import one_of
from clpipe.camera.profile import DEFAULT_CAMERA
from clpipe.chain.drawing import check_draws, draw_of, isos_of, limits_at, values_of
from clpipe.chain.draws import Draw, Limits
from clpipe.chain.keys import KEYS, OUTPUT, check_type, names_in
from clpipe.chain.methods import base_name, make_method, make_output, method_of, stage_named
from clpipe.chain.paths import from_folder
from clpipe.chain.registry import all_stages, load_stage_file
from clpipe.images.dump import Dump, dump_of
from clpipe.images.encoding import Output
from clpipe.stages import DEFAULT_CHAIN


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

        The values depend on the seed and the image key alone (see :mod:`clpipe.chain.draws`).
        Frames of a burst share the key, and so the values, of their image.

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
