"""The sidecar: everything that is needed to make a picture again, and to see that it is done."""

import json
import os
import platform
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from functools import cache
from importlib.metadata import version
from pathlib import Path
from typing import Any

from clpipe.base.about import __version__
from clpipe.base.digests import digests, stamp_of
from clpipe.base.errors import ImageError
from clpipe.base.files import write_beside
from clpipe.base.reading import check_regular, read_bytes
from clpipe.engine.device import Device
from clpipe.engine.runner import Result
from clpipe.images.read import SourceImage
from clpipe.images.write import versions
from clpipe.inputs.find import Job
from clpipe.inputs.raw import RawImage
from clpipe.outputs.renditions import Rendition

SIDECAR = "json"  # the ending of its name

OWN = "clpipe"  # the first key of every sidecar

MARKED = 1 << 16  # bytes at either end of a file, in which a format of clpipe names clpipe

BEGINNING = f'{{\n  "{OWN}": '.encode()


def is_done(path: Path, job: Job, request: Mapping[str, Any], outputs: Sequence[Path]) -> bool:
    """Whether a picture is there, made of the same input by the same request and this version.

    Args:
        path: of the sidecar.
        job: the image.
        request: the record of the request for the image.
        outputs: the files that must be there.

    Raises:
        ImageError: the sidecar is somebody else's file.
    """
    try:
        values = read_sidecar(path)
    except FileNotFoundError:
        return False
    return all(map(os.path.exists, outputs)) and is_current(values, job, request)


def is_current(values: Mapping[str, Any], job: Job, request: Mapping[str, Any]) -> bool:
    """Whether a sidecar's values are of the same input, the same request and this version.

    An input of the same size and time of change is taken for the same; else its SHA-256 decides.
    Arguments as for :func:`is_done`.
    """
    if values.get(OWN) != __version__ or not _same_request(values.get("request"), request):
        return False
    size, modified = stamp_of(job.path)
    if values.get("input_size") != size:
        return False
    if values.get("input_modified") == modified:
        return True
    return values.get("sha256") in digests([str(job.path)]).values()


def _same_request(one: Any, other: Mapping[str, Any]) -> bool:
    """Whether records of requests are equal, with files compared by content and not by name."""
    if one == other:
        return True
    if not isinstance(one, dict) or not (other["files"] and one.get("files")):
        return False
    texts = []
    for values in (one, other):
        text = json.dumps({k: v for k, v in values.items() if k != "files"}, sort_keys=True)
        for file, digest in values["files"].items():
            text = text.replace(json.dumps(file), json.dumps(digest))
        texts.append(text)
    return texts[0] == texts[1]


def read_sidecar(path: Path) -> dict[str, Any]:
    """A sidecar's values.

    Raises:
        FileNotFoundError: it is missing, or is empty or cut off, as a loss of power may leave it.
        ImageError: it cannot be read, or clpipe did not write it.
    """
    try:
        data = read_bytes(path)
    except FileNotFoundError:
        raise
    except OSError as error:
        raise ImageError(f"{path}: cannot be read: {error.strerror}") from None
    try:
        values = json.loads(data)
    except (ValueError, RecursionError):
        values = None
        if not data.strip(b"\0") or data.startswith(BEGINNING):
            raise FileNotFoundError(path) from None
    if not isinstance(values, dict) or OWN not in values:
        raise ImageError(
            f"{path}: clpipe did not write this file, and would overwrite it with its sidecar; "
            "move it, choose another output folder, or say --overwrite"
        )
    return values


def check_own(path: Path) -> None:
    """See that a picture without a sidecar, which would be overwritten, is one of clpipe's.

    Each format names clpipe before or behind its pixels. A run that was killed may have left a
    picture without a sidecar.

    Raises:
        ImageError: it is somebody else's.
    """
    try:
        check_regular(path)
        with open(path, "rb") as file:
            ends = file.read(MARKED)
            file.seek(max(os.fstat(file.fileno()).st_size - MARKED, 0))
            ends += file.read(MARKED)
    except OSError:
        return  # it is missing, or writing to it will say why
    if ends and OWN.encode() not in ends:
        raise ImageError(
            f"{path}: clpipe did not write this picture, and would overwrite it; "
            "move it, choose another output folder, or say --overwrite"
        )


def write_sidecar(path: Path, record: Mapping[str, Any]) -> None:
    """Write the sidecar of a picture, whose files are all there.

    Raises:
        ImageError: it cannot be written.
    """
    data = json_text(record).encode()
    write_beside(path, lambda to: to.write_bytes(data))


def json_text(record: Mapping[str, Any]) -> str:
    """JSON with a line for each key, and for each object of a list.

    >>> print(json_text({"a": 1, "b": [{"c": 2}, {"d": [3, 4]}]}), end="")
    {
      "a": 1,
      "b": [
        {"c": 2},
        {"d": [3, 4]}
      ]
    }
    """
    lines = []
    for key, value in record.items():
        text = json.dumps(value)
        if isinstance(value, list) and value and isinstance(value[0], dict):
            each = ",\n".join(f"    {json.dumps(one)}" for one in value)
            text = f"[\n{each}\n  ]"
        lines.append(f"  {json.dumps(key)}: {text}")
    return "{\n" + ",\n".join(lines) + "\n}\n"


def sidecar(
    job: Job,
    request: Mapping[str, Any],
    stamp: tuple[int, int],
    rendition: Rendition,
    frames: int | None,
    device: Device | None,
    source: SourceImage,
    result: Result,
    outputs: Sequence[str],
) -> dict[str, Any]:
    """Everything that is needed to make the files of a rendition again, as JSON values.

    Args:
        job: the image.
        request: the record of the request for the image.
        stamp: the input's size and time of change, before it was read.
        rendition: the picture.
        frames: how many frames its burst has; None without a burst.
        device: where it was made; None is NumPy.
        source: the image, as it was loaded.
        result: what was made of it.
        outputs: the names of the files.
    """
    chain = rendition.whole
    facts = source.facts if isinstance(source, RawImage) else None
    noise = chain.noise if not facts or chain.is_noisy else None
    size, modified = stamp
    return {
        OWN: __version__,
        "input": str(job.path),
        "input_size": size,
        "input_modified": modified,
        "sha256": source.sha256,
        "layer": source.layer,
        "name": job.stem,
        "picture": rendition.name,
        "frames": frames,
        "image_key": rendition.key,
        "seed": chain.seed,
        "width": source.pixels.shape[1],
        "height": source.pixels.shape[0],
        "camera": chain.camera.name,
        "iso": chain.iso,
        "output": chain.settings.output.filled(source.shot).model_dump(),
        "noise": noise.record() if noise else None,
        "starts_on": chain.source.label,
        **({"raw": asdict(facts)} if facts else {}),
        "stages": [
            {
                "name": step.name,
                "stage": step.stage.name,
                "method": step.method.method,
                "parameters": step.method.model_dump(),
                **(
                    {"estimates": result.estimates[step.name]}
                    if step.name in result.estimates
                    else {}
                ),
            }
            for step in chain.steps
        ],
        "outputs": list(outputs),
        "warnings": list(source.warnings),
        "device": {
            "name": device.info.name if device else "numpy",
            "platform": device.info.platform if device else "numpy",
            "version": device.info.version if device else all_versions()["numpy"],
            "driver": device.info.driver if device else "",
            "lanes": device.info.lanes if device else 0,
        },
        "versions": all_versions(),
        "request": request,
    }


@cache
def all_versions() -> dict[str, str]:
    """The versions of all that a picture's bytes may depend on, by name."""
    return {
        "python": platform.python_version(),
        "numpy": version("numpy"),
        "pyopencl": version("pyopencl"),
        **versions(),
    }
