"""The controls of the page: stages, methods and parameters, from their declarations."""

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

from pydantic import BaseModel

from clpipe.base.errors import KeyedError
from clpipe.camera.lens import INSTALL, lens_names
from clpipe.camera.profile import built_in_cameras, load_camera
from clpipe.chain.keys import KEYS, LENS
from clpipe.chain.lens_presets import PRESETS
from clpipe.chain.methods import base_name
from clpipe.chain.registry import all_stages
from clpipe.chain.settings import Settings
from clpipe.stage import Kind, Stage

OMITTED_KEYS = {"title", "description"}  # keys of a schema; the description is sent as "text"


def stage_controls() -> dict[str, Any]:
    """Return every stage by its name, with its summary, methods and parameters.

    A parameter is a JSON schema with type, limits, unit and default. Its "text" describes it, and
    its "auto" states the source of a value that is not set.
    """
    return {
        name: {
            "summary": stage.summary,
            "role": stage.role.name if stage.role else "",
            "methods": [
                {
                    "name": method.method,
                    "summary": method.summary,
                    "parameters": parameters_of(method),
                }
                for method in stage.methods
            ],
        }
        for name, stage in all_stages().items()
    }


def parameters_of(model: type[BaseModel]) -> dict[str, Any]:
    """Return the parameters that a class declares, each as a JSON schema with a text.

    >>> from clpipe.stages.gamma import STAGE
    >>> list(parameters_of(STAGE.methods[0]))
    []
    """
    properties = model.model_json_schema().get("properties", {})
    return {
        name: {k: v for k, v in schema.items() if k not in OMITTED_KEYS}
        | {"text": schema.get("description", "")}
        for name, schema in properties.items()
    }


def key_controls() -> dict[str, Any]:
    """Return the settings outside tables, each as a JSON schema with a text.

    The schema of "lens" lists names as "suggested", or states what to install for more of them.
    """
    names = {int: "integer", str: "string", float: "number"}
    controls: dict[str, dict[str, Any]] = {}
    for known in (KEYS[key] for key in (*LENS, "seed", "noise_key")):
        about = {"type": names[known.type_], "text": known.text, "unit": known.unit}
        limit = {"exclusiveMinimum": known.above} if known.above == 0 else {}
        controls[known.name] = {**about, "plain": True, **limit}
    controls["lens"]["suggested"] = [*PRESETS]
    try:
        controls["lens"]["suggested"] += lens_names()
    except KeyedError:
        controls["lens"]["text"] += f" It needs {INSTALL}."
    return controls


def camera_controls(others: Sequence[str]) -> list[dict[str, Any]]:
    """Return the built-in cameras and the cameras of the files, with their ISO ranges.

    Raises:
        RequestError: a file is not a camera profile.
    """
    cameras = [(name, load_camera(name)) for name in (*sorted(built_in_cameras()), *others)]
    return [
        {
            "value": name,
            "label": f"{camera.make} {camera.model}".strip() or Path(name).name,
            "isos": list(camera.iso_range),
        }
        for name, camera in cameras
    ]


def steps_of(settings: Settings) -> list[dict[str, Any]]:
    """Return all steps of settings in order, including skipped ones, with stage and group."""
    on = set(settings.step_names)
    every = Settings(stages=settings.stages).step_names
    stages = [base_name(name) for name in every]
    groups = groups_of([all_stages()[stage] for stage in stages])
    return [
        {"name": name, "stage": stage, "group": group, "on": name in on}
        for name, stage, group in zip(every, stages, groups, strict=True)
    ]


def groups_of(stages: Sequence[Stage]) -> Iterator[str]:
    """Yield the group of each stage of a chain: Optics, Sensor or Development.

    Without a mosaic there is no sensor, and all stages are Development.

    >>> list(groups_of([all_stages()[n] for n in ("vignetting", "mosaic", "quantize", "demosaic")]))
    ['Optics', 'Sensor', 'Sensor', 'Development']
    """
    ends = [(stage.reads, stage.writes) for stage in stages]
    group = "Optics" if (Kind.RGB, Kind.MOSAIC) in ends else "Development"
    for reads, writes in ends:
        if (reads, writes) == (Kind.RGB, Kind.MOSAIC):
            group = "Sensor"
        elif reads is Kind.RAW or (reads, writes) == (Kind.MOSAIC, Kind.RGB):
            group = "Development"
        yield group
