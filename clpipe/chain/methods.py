"""Look up the methods of stages by name, and build them from validated tables of parameters."""

import re
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from functools import lru_cache
from typing import Any

from pydantic import BaseModel, ValidationError

from clpipe.base.errors import KeyedError
from clpipe.base.text import unknown_name
from clpipe.base.validation import first_fault
from clpipe.camera.control import Control
from clpipe.chain.keys import CONTROL, NOISE, OUTPUT, RENDER, setting_error
from clpipe.chain.registry import all_stages
from clpipe.chain.render_camera import RenderCamera
from clpipe.images.encoding import Encoding
from clpipe.stage import Method, Stage


@lru_cache(maxsize=1024)
def base_name(step: str) -> str:
    """Return the stage name of a step, which may be a repeated stage.

    >>> base_name("denoise_2")
    'denoise'
    """
    return re.sub(r"_\d+$", "", step)


def step_names_of(stages: Sequence[str]) -> list[str]:
    """Return the names of the steps of stages. A repeated stage gets a number.

    >>> step_names_of(["denoise", "gamma", "denoise"])
    ['denoise', 'gamma', 'denoise_2']
    """
    before = [stages[:place].count(stage) for place, stage in enumerate(stages)]
    pairs = zip(stages, before, strict=True)
    return [f"{stage}_{count + 1}" if count else stage for stage, count in pairs]


@lru_cache(maxsize=64)
def step_names(stages: tuple[str, ...], skip: tuple[str, ...]) -> tuple[str, ...]:
    """Return the names of the steps, see :attr:`clpipe.chain.settings.Settings.step_names`."""
    return tuple(name for name in step_names_of(stages) if name not in skip)


def stage_named(key: str, name: str) -> Stage:
    """Return the stage with a name.

    Args:
        key: the key or option that has this name, for the error.
        name: the name of the stage.

    Raises:
        KeyedError: there is no such stage.
    """
    if name not in all_stages():
        if base_name(name) in all_stages():
            stage = base_name(name)
            message = f"{name}: this names a repeated stage; to repeat it, list {stage} again"
            raise KeyedError(key, f"{message}. The second is then called {stage}_2")
        raise KeyedError(key, unknown_name("stage", name, all_stages()))
    return all_stages()[name]


def check_step(key: str, name: str) -> None:
    """Check that a name is allowed under "stages" or "skip".

    Raises:
        KeyedError: the name is no stage. "noise" is also allowed under "skip".
    """
    if key == "stages":
        stage_named(key, name)
    elif name != NOISE and base_name(name) not in all_stages():
        raise KeyedError(key, f"skip: {unknown_name('stage', name, (NOISE, *all_stages()))}")


def parameter_names() -> list[str]:
    """Return the parameters of all stages and tables, each once, as ``stage.parameter``."""
    models = [(stage.name, method) for stage in all_stages().values() for method in stage.methods]
    pairs = [*models, *TABLE_MODELS.items()]
    return list(
        dict.fromkeys(f"{name}.{key}" for name, model in pairs for key in model.model_fields)
    )


def method_name(name: str, table: Mapping[str, Any]) -> Any:
    """Return the name of the method in a step's table; else of the stage's default method."""
    stage = all_stages().get(base_name(name))
    return table.get("method", stage.methods[0].method if stage else None)


def stage_of(step: str) -> Stage:
    """Return the stage of a step, which may be a repeated stage.

    Raises:
        KeyedError: there is no such stage.
    """
    return stage_named(step, base_name(step))


def make_model(name: str, table: Mapping[str, Any]) -> Any:
    """Validate a table.

    Args:
        name: the name of a step, or of a table that belongs to no stage, see :data:`TABLE_MODELS`.
        table: values by name. In a step's table, "method" chooses the method.

    Returns:
        The method of the step, or the model of the other table.

    Raises:
        KeyedError: a stage, method or name is unknown, or a value is not allowed.
    """
    if name in TABLE_MODELS:
        model = TABLE_MODELS[name]
    elif table:
        model = method_named(stage_of(name), name, method_name(name, table))
        table = {k: v for k, v in table.items() if k != "method"}
    else:
        return default_method(stage_of(name).methods[0], name)
    with validation_errors(name, model):
        return model.model_validate(dict(table))


@lru_cache(maxsize=1024)
def default_method(method: type[Method], name: str) -> Method:
    """Return a method with all parameters at their defaults. It is cached, as methods are frozen.

    Raises:
        KeyedError: a parameter has no default.
    """
    with validation_errors(name, method):
        return method()


def method_named(stage: Stage, name: str, chosen: Any) -> type[Method]:
    """Return the method of a stage by its name.

    Args:
        stage: the stage.
        name: the name of the step, for the message.
        chosen: the name of the method.

    Raises:
        KeyedError: the stage has no such method.
    """
    if not isinstance(chosen, str) or chosen not in stage.by_name:
        message = unknown_name("method", str(chosen), stage.by_name)
        raise setting_error(f"{name}.method: {message}")
    return stage.by_name[chosen]


# Models of the tables that do not belong to a stage.
TABLE_MODELS: dict[str, type[BaseModel]] = {
    OUTPUT: Encoding,
    RENDER: RenderCamera,
    CONTROL: Control,
}


@contextmanager
def validation_errors(name: str, model: type[BaseModel]) -> Iterator[None]:
    """Convert pydantic's errors about a table into messages that name the table.

    Args:
        name: the name of the step, or of another table.
        model: the model that declares the table's keys.

    Raises:
        KeyedError: a key is unknown, or its value is not allowed.
    """
    try:
        yield
    except ValidationError as error:
        fault = first_fault(error)
        if fault.problem == "unknown":
            raise unknown_parameter(name, model, str(fault.path[0])) from None
        key = ".".join([name, *(str(part) for part in fault.path[:1])])
        place = f"{name}.{fault.key}" if fault.path else name
        raise KeyedError(key, f"{place}: {fault.text}") from None


def unknown_parameter(step: str, model: type[BaseModel], parameter: str) -> KeyedError:
    """Return the error for a parameter that a step, or another table, does not have."""
    key = f"{step}.{parameter}"
    if not issubclass(model, Method):
        return KeyedError(key, unknown_name(f"key of {step}", parameter, model.model_fields))
    what = f"parameter of {step} ({model.method})"
    message = unknown_name(what, parameter, ["method", *model.model_fields])
    stage = all_stages()[base_name(step)]
    others = [m for m, other in stage.by_name.items() if parameter in other.model_fields]
    if others:
        message += f"; '{parameter}' is a parameter of {' and '.join(others)}"
    return KeyedError(key, message)
