"""Makes a picture again from its sidecar: the same bytes, or a reason why not."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from clpipe.base.about import __version__
from clpipe.base.digests import digests
from clpipe.base.errors import ImageError, RequestError
from clpipe.chain.request import Request
from clpipe.inputs.find import Job
from clpipe.inputs.manifest import check_output_name
from clpipe.outputs.renditions import RenditionPlan, truth_named
from clpipe.outputs.sidecar import all_versions, read_sidecar


@dataclass(frozen=True)
class Replay:
    """One picture to make again.

    Args:
        request: what the sidecar says was asked for.
        job: the image, and the rendition of it.
        warning: why the bytes may differ after all; "" where nothing is known.
    """

    request: Request
    job: Job
    warning: str


def replay_of(path: Path, inputs: Sequence[Path], max_pixels: int | None) -> Replay:
    """What is to be made again, by its sidecar.

    Args:
        path: of the sidecar.
        inputs: where its input is now; none means, where it was.
        max_pixels: as for :class:`~clpipe.chain.request.Request`.

    Raises:
        RequestError: it is no sidecar, or one of another version, or the input or a file that was
            used (a camera profile, a curve, a stage) is missing or has changed.
    """
    if len(inputs) > 1:
        raise RequestError(f"{path}: it has one input; found {len(inputs)}")
    values = _values(path)
    try:
        replay = _replay(values, inputs, max_pixels)
        files = {str(name): str(digest) for name, digest in values["request"]["files"].items()}
        files[str(replay.job.path)] = str(values["sha256"])
        if not set(replay.request.stage_files) <= files.keys():
            raise RequestError("it names a stage file without its SHA-256")
    except (KeyError, TypeError, ValueError, AttributeError, RequestError) as error:
        raise RequestError(f"{path}: it is damaged: {error}") from None
    _check_files(path, files)  # before settings() runs stage files, which are among them
    try:
        replay.request.settings()
    except (TypeError, ValueError, AttributeError, RequestError) as error:
        raise RequestError(f"{path}: it is damaged: {error}") from None
    return replay


def _values(path: Path) -> dict[str, Any]:
    """The values of a sidecar of this version.

    Raises:
        RequestError: it is none.
    """
    try:
        values = read_sidecar(path)
    except FileNotFoundError:
        raise RequestError(f"{path}: no such file") from None
    except ImageError:
        raise RequestError(
            f"{path}: clpipe did not write this file; --replay takes a sidecar"
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
    name, picture, frames = str(values["name"]), str(values["picture"]), values["frames"]
    check_output_name(name)
    if not (frames is None or frames > 0):
        raise RequestError(f"found frames {frames}")
    truths = tuple(filter(None, [truth_named(picture)]))
    if picture not in RenditionPlan(frames, truths).names():
        raise RequestError(f"found picture {picture!r}")
    request = Request.from_record(values["request"])
    if not request.formats:
        raise RequestError("found no formats")
    request = replace(request, max_pixels=max_pixels, frames=frames, truths=truths)
    path = inputs[0] if inputs else Path(values["input"])
    job = Job(path, request.image_key, name, values=request.image, pictures=(picture,))
    were = values["versions"]
    changed = [
        f"{library} {were[library]}"
        for library, now in all_versions().items()
        if were[library] != now
    ]
    text = f"was made with {', '.join(changed)}; the bytes may be others" if changed else ""
    return Replay(request, job, text)


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
