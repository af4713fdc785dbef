"""The sidecar: everything that is needed to make a picture again, and whether it must be."""

import json
import os
import platform
from collections.abc import Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import asdict
from functools import cache, lru_cache
from importlib.metadata import version
from pathlib import Path
from typing import Any

from clpipe.base.about import __version__
from clpipe.base.errors import ImageError
from clpipe.base.files import sha256_of, write_beside
from clpipe.chain.request import Request
from clpipe.engine.device import Device
from clpipe.engine.runner import Result
from clpipe.images.read import ReadOptions, SourceImage
from clpipe.images.write import versions
from clpipe.inputs.find import Job
from clpipe.inputs.raw import RawImage
from clpipe.outputs.renditions import Rendition
from clpipe.outputs.writer import OutputWriter

OWN = "clpipe"  # the key that every sidecar has, its first one


NEAR = 1 << 16  # bytes in which a file says who wrote it


BEGINNING = f'{{\n  "{OWN}": '.encode()


def wanted(asked: Request, reading: ReadOptions, target: OutputWriter) -> dict[str, Any]:
    """What is to be made, as far as it is known before the image is read.

    What is equal here makes the same bytes of the same image under the same image key.
    """
    record = {
        **asked.record(),
        "layer": reading.layer,
        "transfer": reading.transfer,
        "formats": target.formats,
        "keep": target.keep,
        "files": digests([*asked.settings().files(), *asked.stage_files]),
    }
    found: dict[str, Any] = json.loads(json.dumps(record))  # as a sidecar will have it
    return found


def stamp_of(path: Path) -> tuple[int, int]:
    """The size of a file and its time of change (ns); zeros where it cannot be seen."""
    try:
        info = path.stat()
    except OSError:
        return (0, 0)
    return info.st_size, info.st_mtime_ns


def digests(files: Iterable[str]) -> dict[str, str]:
    """The SHA-256 of each of these files that can be read."""
    found = {}
    for file in files:
        with suppress(OSError):
            found[file] = _digest(file, *stamp_of(Path(file)))
    return found


@lru_cache(maxsize=1024)
def _digest(file: str, size: int, modified: int) -> str:
    return sha256_of(Path(file))[0]


def is_done(path: Path, job: Job, wanted: Mapping[str, Any], outputs: Sequence[Path]) -> bool:
    """Whether a picture is there already, made of the same input, in the same way, by this version.

    Args:
        path: of the sidecar.
        job: the image.
        wanted: what is to be made, as :func:`wanted` says it, and the image key.
        outputs: the files that must be there.

    Raises:
        ImageError: the sidecar is somebody else's file.
    """
    try:
        found = read_sidecar(path)
    except FileNotFoundError:
        return False
    return all(map(os.path.exists, outputs)) and is_as_wanted(found, job, wanted)


def is_as_wanted(found: Mapping[str, Any], job: Job, wanted: Mapping[str, Any]) -> bool:
    """Whether a sidecar's values are of the same input, the same wishes and this version.

    An input of the same size and time of change is taken for the same; else its SHA-256 decides.
    ``wanted`` as for :func:`is_done`.
    """
    if found.get(OWN) != __version__ or not _same(found.get("asked"), wanted):
        return False
    size, modified = stamp_of(job.path)
    if found.get("input_size") != size:
        return False
    if found.get("input_modified") == modified:
        return True
    return found.get("sha256") in digests([str(job.path)]).values()


def _same(asked: Any, wanted: Mapping[str, Any]) -> bool:
    """Whether the same was asked for; files that are named by their contents, wherever they lie."""
    if asked == wanted:
        return True
    if not isinstance(asked, dict) or not (wanted["files"] and asked.get("files")):
        return False
    texts = []
    for values in (asked, wanted):
        text = json.dumps({k: v for k, v in values.items() if k != "files"}, sort_keys=True)
        for file, digest in values["files"].items():
            text = text.replace(json.dumps(file), json.dumps(digest))
        texts.append(text)
    return texts[0] == texts[1]


def read_sidecar(path: Path) -> dict[str, Any]:
    """A sidecar's values.

    Raises:
        FileNotFoundError: it is not there, or is empty or cut off, as a loss of power may leave it.
        ImageError: it cannot be read, or clpipe did not write it.
    """
    try:
        data = path.read_bytes()
    except FileNotFoundError:
        raise
    except OSError as error:
        raise ImageError(f"{path}: cannot be read: {error.strerror}") from None
    try:
        found = json.loads(data)
    except (ValueError, RecursionError):
        found = None
        if not data.strip(b"\0") or data.startswith(BEGINNING):
            raise FileNotFoundError(path) from None
    if not isinstance(found, dict) or OWN not in found:
        raise ImageError(
            f"{path}: clpipe did not write this file, and would overwrite it with its sidecar; "
            "move it, choose another output folder, or say --overwrite"
        )
    return found


def check_own(path: Path) -> None:
    """See that a picture that would be written over, and has no sidecar, is one of clpipe's.

    All its formats say so, before their pixels or behind them; a run that was killed may have left
    one without a sidecar.

    Raises:
        ImageError: it is somebody else's.
    """
    try:
        with open(path, "rb") as file:
            ends = file.read(NEAR)
            file.seek(max(os.fstat(file.fileno()).st_size - NEAR, 0))
            ends += file.read(NEAR)
    except OSError:
        return  # it is not there, or the writing of it says why
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
    stamp: tuple[int, int],
    shot: Rendition,
    frames: int | None,
    device: Device | None,
    source: SourceImage,
    result: Result,
    outputs: Sequence[str],
) -> dict[str, Any]:
    """Everything that is needed to make the same files again."""
    chain = shot.whole
    raw = source.said if isinstance(source, RawImage) else None
    noise = chain.noise if not raw or chain.is_noisy else None
    size, modified = stamp
    return {
        OWN: __version__,
        "input": str(job.path),
        "input_size": size,
        "input_modified": modified,
        "sha256": source.sha256,
        "layer": source.layer,
        "name": job.stem,
        "picture": shot.name,
        "frames": frames,
        "image_key": shot.key,
        "seed": chain.seed,
        "width": source.pixels.shape[1],
        "height": source.pixels.shape[0],
        "camera": chain.camera.name,
        "iso": chain.iso,
        "output": chain.settings.output.filled(source.shot).model_dump(),
        "noise": noise.record() if noise else None,
        "starts_on": chain.source.label,
        **({"raw": asdict(raw)} if raw else {}),
        "stages": [
            {
                "name": step.name,
                "stage": step.stage.name,
                "method": step.method.method,
                "parameters": step.method.model_dump(),
                **({"found": result.found[step.name]} if step.name in result.found else {}),
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
    }


@cache
def all_versions() -> dict[str, str]:
    """The versions of what a picture's bytes may depend on."""
    return {
        "python": platform.python_version(),
        "numpy": version("numpy"),
        "pyopencl": version("pyopencl"),
        **versions(),
    }
