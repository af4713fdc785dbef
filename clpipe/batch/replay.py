"""Makes a picture again from its sidecar: the same bytes, or a reason why not."""

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from clpipe.base.about import __version__
from clpipe.base.digests import digests
from clpipe.base.errors import ImageError, RequestError
from clpipe.base.urls import fetch, path_of
from clpipe.chain.registry import code_files
from clpipe.chain.rendition import BASELINES, TRUTHS, Rendition
from clpipe.chain.request import Request
from clpipe.inputs.find import Job
from clpipe.inputs.manifest import check_output_name
from clpipe.outputs.sidecar import SidecarError, input_entries, output_entries, read_sidecar

CODE = (".py", ".cl")  # the endings of files that are run


@dataclass(frozen=True)
class Replay:
    """One picture to make again.

    Args:
        request: the request in the sidecar.
        job: the image, and the rendition of it.
        made: what the sidecar says of the program, the device and the versions of libraries.
        outputs: the SHA-256 of the files that it lists, by their names.
    """

    request: Request
    job: Job
    made: Mapping[str, str]
    outputs: Mapping[str, str]

    def comparison(self, sidecar: Path) -> tuple[bool, str]:
        """Whether the picture's bytes are the same, and in words, with what differs if not.

        ``sidecar`` is that of the picture that was made again.

        Raises:
            ImageError: there is none, or it is damaged.
        """
        try:
            values = read_sidecar(sidecar)
        except FileNotFoundError:
            raise ImageError(f"{sidecar}: it is not there any more") from None
        made, now = digests_in(values), surroundings_in(values)
        others = sorted(n for n in {*self.outputs, *made} if self.outputs.get(n) != made.get(n))
        if not others:
            return True, "the same bytes"
        changed = [
            f"{what} {short(was) or 'unknown'} (now {short(now.get(what, '')) or 'unknown'})"
            for what, was in self.made.items()
            if was != now.get(what)
        ]
        why = f"made with {', '.join(changed)}" if changed else "by the same program and device"
        return False, f"other bytes ({', '.join(others)}): {why}"


def digests_in(values: Mapping[str, Any]) -> dict[str, str]:
    """The SHA-256 of the files that a sidecar's values list, by their names."""
    return {name: str(each["sha256"]) for name, each in output_entries(values).items()}


def short(value: str) -> str:
    """Shorten a digest for people; return other values unchanged."""
    return value[:12] if re.fullmatch("[0-9a-f]{64}", value) else value


def surroundings_in(values: Mapping[str, Any]) -> dict[str, str]:
    """Return what a picture's bytes depend on besides the request, by name, from a sidecar.

    Raises:
        KeyError, TypeError, AttributeError: they are damaged.
    """
    versions = {name: str(version) for name, version in values["versions"].items()}
    return {"program": str(values["program"]), **flat(values["device"]), **versions}


def flat(device: Mapping[str, Any]) -> dict[str, str]:
    """The values of a sidecar's device, by names that a reader understands.

    >>> flat({"name": "RTX 5090", "lanes": 1})
    {'device name': 'RTX 5090', 'device lanes': '1'}
    """
    return {f"device {key}": str(value) for key, value in device.items()}


def replay_of(
    path: Path,
    inputs: Sequence[Path],
    max_pixels: int | None,
    stage_files: Sequence[Path] = (),
) -> Replay:
    """What is to be made again, by its sidecar.

    Args:
        path: of the sidecar.
        inputs: where its input is now; none means, where it was.
        max_pixels: as for :class:`~clpipe.chain.request.Request`.
        stage_files: code that may be run. Files that only a sidecar names are not run.

    Raises:
        RequestError: it is no sidecar, or one of another version. Or the input or a file that was
            used (a camera profile, a curve) is missing or has changed. Or it was made with stage
            files that are not among these.
    """
    if len(inputs) > 1:
        raise RequestError(f"{path}: it has one input; found {len(inputs)}")
    values = _values(path)
    try:
        replay = _replay(values, inputs, max_pixels)
        files = {str(name): str(digest) for name, digest in values["request"]["files"].items()}
        of = input_entries(values, replay.job.paths)
        files |= {str(path): str(was["sha256"]) for path, was in of}
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
    """The values of a sidecar of this version.

    Raises:
        RequestError: it is none.
    """
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
    return values


def _replay(values: Mapping[str, Any], inputs: Sequence[Path], max_pixels: int | None) -> Replay:
    """The replay of a sidecar's values.

    Raises:
        RequestError, KeyError, TypeError, ValueError, AttributeError: they are damaged.
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
    others = tuple(path.parent / str(each["file"]) for each in values.get("subframes", ())[1:])
    job = Job(
        path,
        request.image_name,
        name,
        values=request.image,
        renditions=(rendition,),
        subframes=others,
    )
    return Replay(request, job, surroundings_in(values), digests_in(values))


def _check_code(path: Path, code: Mapping[str, str], stage_files: Sequence[Path]) -> None:
    """See that the code of a sidecar is that of stage files which the user named.

    Args:
        path: of the sidecar, for messages.
        code: the SHA-256 of each file of code, by its name.
        stage_files: those that the user named; only they are loaded.

    Raises:
        RequestError: a file is not among them.
    """
    trusted = digests(map(str, code_files(stage_files))).values()
    for name, was in code.items():
        if was not in trusted:
            raise RequestError(
                f"{path}: was made with {name} (SHA-256 {was[:12]}...), and a sidecar runs no "
                "code; where you trust that file, name it: --stage-file FILE.py"
            )


def _check_files(path: Path, files: Mapping[str, str]) -> None:
    """See that files are what they were.

    Args:
        path: of the sidecar, for messages.
        files: the SHA-256 of each, by its name.

    Raises:
        RequestError: one cannot be read, or has changed.
    """
    for name, was in files.items():
        now = digests([name]).get(name)
        if now is None:
            raise RequestError(f"{path}: {name}: cannot be read, and was used")
        if now != was:
            raise RequestError(
                f"{path}: {name}: has changed since (SHA-256 {now[:12]}..., was {was[:12]}...), so "
                "the picture would be another one"
            )
