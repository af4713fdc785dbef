"""Models of what commands print with ``--json``, from which their JSON Schemas are made."""

from typing import Any, NotRequired

from typing_extensions import TypedDict

from clpipe.outputs.schema import Number

Object, Objects, Texts = dict[str, Any], list[dict[str, Any]], list[str]
MACHINE = {"clpipe": str, "device": Object, "versions": dict[str, str]}

# The keys of each command, with their types. Keys that end in "?" may be missing.
KEYS: dict[str, dict[str, Any]] = {
    "bench": MACHINE
    | {
        "methods?": Any,
        "batches?": Objects,
        "chain?": Object,
        "launches?": Objects,
        "width?": int,
        "height?": int,
    }
    | dict.fromkeys(("mp_per_s?", "bytes_per_pixel?", "copy_gb_per_s?", "first_run_s?"), float),
    "calibrate": {"profile": str, "picture": str, "make?": str, "model?": str}
    | {"isos?": Objects, "figures?": Object},
    "cameras": {"cameras": Objects},
    "cameras import": {"profile": str | None, "toml": str, "make": str, "model": str}
    | {"iso_range": tuple[float, float]},
    "check": MACHINE | {"failed": int, "checks": Objects},
    "compare": {"figures": Texts, "labels": Texts, "places": list[Any], "noise": list[Any] | None}
    | {"looks": Any, "notes": Texts},
    "devices": {"devices": Objects, "unloadable_drivers": Object, "kernel_cache": Object},
    "emva": {"series": str, "bits": int, "bright_pairs": int, "dark_pairs": int}
    | {"stacks": tuple[int, int]},
    "explore": {"address": str, "images": int},
    "match": {"configuration": str, "settings": Object, "searched": Any, "columns": Object}
    | {"evaluations": int, "scenes": Texts, "notes": Texts, "ended_by_range": Any}
    | dict.fromkeys(("ambiguities", "sharpness", "tone"), Any),
    "measure": {"kind?": str, "unit?": str, "channels?": Object, "by_iso?": Object}
    | {"snr?": Objects, "width?": int, "height?": int, "frames?": int, "images?": Texts}
    | {"notes?": Texts, "bursts?": Any, "truth?": Any, "iso?": float | None, "finished?": Any}
    | dict.fromkeys(("share_used?", "rounding_variance?", "edges_over_flat?"), float | None)
    | dict.fromkeys(("correlation?", "covariance?", "temporal_correlation?"), Any),
    "plan": {"launches": Objects, "slots": int, "bytes_per_pixel": float, "kept": Texts},
    "poses": {"folder": str, "files": Texts, "pictures": int, "warnings": Texts},
    "quality": {"quality": Objects},
    "replay": {"picture": str, "same": bool, "text": str},
    "report": {"report": str, "bytes": int},
    "stages": {"stages": Objects},
    "status": {"images": dict[str, int], "tars": dict[str, int], "errors": dict[str, int]}
    | {"slow_tars": dict[str, float], "shards": Object, "complete": bool},
}


def model_of(command: str) -> Any:
    """Return the model of what a command prints with ``--json``.

    >>> from pydantic import TypeAdapter
    >>> TypeAdapter(model_of("report")).json_schema()["required"]
    ['format', 'report', 'bytes']
    """
    fields = {
        key.removesuffix("?"): NotRequired[type_] if key.endswith("?") else type_
        for key, type_ in KEYS[command].items()
    }
    return TypedDict(command, {"format": Number, **fields})  # type: ignore[operator]
