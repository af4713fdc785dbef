"""What a page can set: the stages of a chain with their methods and parameters, as declared."""

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

from pydantic import BaseModel

from clpipe.base.errors import KeyedError
from clpipe.camera.lens import INSTALL, lens_names
from clpipe.camera.profile import built_in_cameras, load_camera
from clpipe.chain.keys import KEYS, LENS
from clpipe.chain.methods import base_name
from clpipe.chain.registry import all_stages
from clpipe.chain.settings import Settings
from clpipe.stage import Kind, Stage

HIDDEN = {"title", "description"}  # of a parameter's schema; the description is sent as "text"


def stage_controls() -> dict[str, Any]:
    """Every stage by its name: what it does, and its methods with their parameters.

    A parameter is its JSON schema, which has its type, limits, unit and default; "text" says what
    it is, "auto" where its value comes from when it is not set.
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
    """The parameters that a class declares, each as its JSON schema with a text.

    >>> from clpipe.stages.gamma import STAGE
    >>> list(parameters_of(STAGE.methods[0]))
    []
    """
    properties = model.model_json_schema().get("properties", {})
    return {
        name: {k: v for k, v in schema.items() if k not in HIDDEN}
        | {"text": schema.get("description", "")}
        for name, schema in properties.items()
    }


def key_controls() -> dict[str, Any]:
    """The values that stand in no table, each as a JSON schema with a text.

    That of "lens" has all names as "suggested", or says what to install for them.
    """
    names = {int: "integer", str: "string", float: "number"}
    controls: dict[str, dict[str, Any]] = {}
    for known in (KEYS[key] for key in (*LENS, "seed", "noise_key")):
        about = {"type": names[known.type_], "text": known.text, "unit": known.unit}
        limit = {"exclusiveMinimum": known.above} if known.above == 0 else {}
        controls[known.name] = {**about, "plain": True, **limit}
    try:
        controls["lens"]["suggested"] = lens_names()
    except KeyedError:
        controls["lens"]["text"] += f" It needs {INSTALL}."
    return controls


def camera_controls(others: Sequence[str]) -> list[dict[str, Any]]:
    """The cameras that can be chosen, with their ISOs: the built-in ones, and files that are named.

    Raises:
        RequestError: a file is no camera profile.
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
