"""Recomputes a picture from its sidecar, and explains differences in its bytes."""

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from clpipe.base.about import __version__
from clpipe.base.digests import digests
from clpipe.base.errors import ImageError, RequestError
from clpipe.base.urls import fetch, path_of
from clpipe.batch.clips import RECORDS
from clpipe.chain.registry import code_files
from clpipe.chain.rendition import BASELINES, TRUTHS, Rendition
from clpipe.chain.request import Request
from clpipe.inputs.find import Job
from clpipe.inputs.manifest import check_output_name
from clpipe.outputs.record import PLACE
from clpipe.outputs.shared import with_shared
from clpipe.outputs.sidecar import SidecarError, input_entries, output_entries, read_sidecar

CODE = (".py", ".cl")  # extensions of code files


@dataclass(frozen=True)
class Replay:
    """A picture to recompute.

    Args:
        request: the request in the sidecar.
        job: the image with the rendition.
        environment: the program, device and library versions that the sidecar states.
        outputs: the SHA-256 of the files that the sidecar lists, by name.
    """

    request: Request
    job: Job
    environment: Mapping[str, str]
    outputs: Mapping[str, str]

    def comparison(self, sidecar: Path) -> tuple[bool, str]:
        """Return whether the picture's bytes are the same, and a text that names differences.

        Args:
            sidecar: the sidecar of the recomputed picture.

        Raises:
            ImageError: the sidecar is missing or damaged.
        """
        try:
            values = read_sidecar(sidecar)
        except FileNotFoundError:
            raise ImageError(f"{sidecar}: this sidecar no longer exists") from None
        digests, current = digests_in(values), environment_in(values, sidecar.parent)
        differing = sorted(
            n for n in {*self.outputs, *digests} if self.outputs.get(n) != digests.get(n)
        )
        if not differing:
            return True, "the same bytes"
        changed = [
            f"{key} {shorten(old) or 'unknown'} (now {shorten(current.get(key, '')) or 'unknown'})"
            for key, old in self.environment.items()
            if old != current.get(key)
        ]
        reason = f"made with {', '.join(changed)}" if changed else "by the same program and device"
        return False, f"other bytes ({', '.join(differing)}): {reason}"


def digests_in(values: Mapping[str, Any]) -> dict[str, str]:
    """Return the SHA-256 of the files that a sidecar's values list, by name."""
    return {name: str(each["sha256"]) for name, each in output_entries(values).items()}


def shorten(value: str) -> str:
    """Shorten a digest for people; return other values unchanged."""
    return value[:12] if re.fullmatch("[0-9a-f]{64}", value) else value


def environment_in(values: Mapping[str, Any], folder: Path) -> dict[str, str]:
    """Return what a picture's bytes depend on besides the request, by name, from a sidecar.

    Without the file of its run, only the program is known.

    Raises:
        KeyError, TypeError, AttributeError: they are damaged.
    """
    whole = with_shared(values, folder)
    versions = {name: str(version) for name, version in whole.get("versions", {}).items()}
    device = device_values(whole.get("device", {}))
    return {"program": str(values["program"]), **device, **versions}


def device_values(device: Mapping[str, Any]) -> dict[str, str]:
    """Return the values of a sidecar's device with descriptive names.

    >>> device_values({"name": "RTX 5090", "lanes": 1})
    {'device name': 'RTX 5090', 'device lanes': '1'}
    """
    return {f"device {key}": str(value) for key, value in device.items()}


def replay_of(
    path: Path,
    inputs: Sequence[Path],
    max_pixels: int | None,
    stage_files: Sequence[Path] = (),
) -> Replay:
    """Return the picture to recompute for a sidecar.

    Args:
        path: the sidecar.
        inputs: the current path of the picture's input; empty if it has not moved.
        max_pixels: as for :class:`~clpipe.chain.request.Request`.
        stage_files: stage files that may be run. Files that only the sidecar names are not run.

    Raises:
        RequestError: the file is not a sidecar, or was written by another version. The input or a
            file that was used (a camera profile, a curve) is missing or has changed. The picture
            was made with other stage files.
    """
    if len(inputs) > 1:
        raise RequestError(f"{path}: it has one input; found {len(inputs)}")
    values = _values(path)
    try:
        replay = _replay(values, path.parent, inputs, max_pixels)
        files = {str(name): str(digest) for name, digest in values["request"]["files"].items()}
        inputs_of_job = input_entries(values, replay.job.paths)
        files |= {str(path): str(expected["sha256"]) for path, expected in inputs_of_job}
    except (KeyError, TypeError, ValueError, AttributeError) as error:
        raise RequestError(f"{path}: it is damaged: {error}") from None
    code = {name: files.pop(name) for name in list(files) if Path(name).suffix in CODE}
    _check_files(path, files)
    _check_code(path, code, stage_files)
    request = replace(replay.request, stage_files=tuple(str(f.resolve()) for f in stage_files))
    replay = replace(replay, request=request)
    try:
        request.settings()
    except (TypeError, ValueError, AttributeError) as error:
        raise RequestError(f"{path}: it is damaged: {error}") from None
    return replay


def _values(path: Path) -> Mapping[str, Any]:
    """Return the values of a sidecar of this version.

    Raises:
        RequestError: the file is not a sidecar, or was written by another version. The picture
            depends on the frames before it.
    """
    if path.suffix == RECORDS:
        raise RequestError(
            f"{path}: this file has the records of a clip or a run; clpipe replay takes the "
            "sidecar of a picture (NAME.json). To repeat a clip, run its settings (NAME.csv) again"
        )
    try:
        values = read_sidecar(path)
    except FileNotFoundError:
        reason = "it is empty" if path.exists() else "no such file"
        raise RequestError(f"{path}: {reason}; clpipe replay takes a sidecar") from None
    except SidecarError as error:
        raise RequestError(str(error)) from None
    except ImageError:
        raise RequestError(
            f"{path}: clpipe did not write this file; clpipe replay takes a sidecar"
        ) from None
    if values["clpipe"] != __version__:
        raise RequestError(
            f"{path}: it is of clpipe {values['clpipe']}, and this is {__version__}, which "
            "may make other bytes; install that version, or run it anew"
        )
    if PLACE in values:
        raise RequestError(
            f"{path}: this picture depends on the frames before it, which clpipe replay does not "
            "make; run the sequence again with clpipe run --sequence"
        )
    return values


def _replay(
    values: Mapping[str, Any], folder: Path, inputs: Sequence[Path], max_pixels: int | None
) -> Replay:
    """Return the picture to recompute for the values of a sidecar.

    Raises:
        RequestError, KeyError, TypeError, ValueError, AttributeError: the values are damaged.
    """
    name, rendition = str(values["name"]), Rendition.from_record(values)
    check_output_name(name)
    request = Request.from_record(values["request"])
    if not request.formats:
        raise RequestError("found no formats")
    request = replace(
        request,
        max_pixels=max_pixels,
        frames=rendition.frames,
        bracket=() if rendition.ev is None else (rendition.ev,),
        truths=(rendition.role,) if rendition.role in TRUTHS else (),
        baselines=(rendition.role,) if rendition.role in BASELINES else (),
    )
    path = inputs[0] if inputs else fetch(path_of(str(values["input"])))
    differing = tuple(path.parent / str(each["file"]) for each in values.get("subframes", ())[1:])
    job = Job(
        path,
        request.image_name,
        name,
        values=request.image,
        renditions=(rendition,),
        subframes=differing,
        is_panorama="panorama" in values,
    )
    return Replay(request, job, environment_in(values, folder), digests_in(values))


def _check_code(path: Path, code: Mapping[str, str], stage_files: Sequence[Path]) -> None:
    """Check that the user named all stage files of a sidecar.

    Args:
        path: the sidecar, for messages.
        code: the SHA-256 of each file with code, by name.
        stage_files: the files that the user named. Only these are loaded.

    Raises:
        RequestError: a file is missing in them, or has changed.
    """
    trusted = digests(map(str, code_files(stage_files))).values()
    for name, expected in code.items():
        if expected not in trusted:
            raise RequestError(
                f"{path}: was made with {name} (SHA-256 {expected[:12]}...), and a sidecar runs no "
                "code; where you trust that file, name it: --stage-file FILE.py"
            )


def _check_files(path: Path, files: Mapping[str, str]) -> None:
    """Check that files have not changed.

    Args:
        path: the sidecar, for messages.
        files: the expected SHA-256 of each file, by name.

    Raises:
        RequestError: a file cannot be read, or has changed.
    """
    for name, expected in files.items():
        current = digests([name]).get(name)
        if current is None:
            raise RequestError(f"{path}: {name}: cannot be read, and was used")
        if current != expected:
            raise RequestError(
                f"{path}: {name}: this file has changed (SHA-256 {current[:12]}..., was "
                f"{expected[:12]}...), so the picture would differ"
            )
