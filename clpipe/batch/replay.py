"""Making a picture again from its sidecar: the same bytes, or a reason why not."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from clpipe.base.about import __version__
from clpipe.base.errors import ImageError, RequestError
from clpipe.chain.request import request_from_record
from clpipe.images.read import ReadOptions
from clpipe.inputs.find import Job
from clpipe.inputs.loader import ImageLoader
from clpipe.inputs.manifest import check_output_name
from clpipe.outputs.formats import EVERY_FORMAT
from clpipe.outputs.renditions import RenditionPlan, truth_named
from clpipe.outputs.sidecar import all_versions, digests, read_sidecar


@dataclass(frozen=True)
class Replay:
    """What a sidecar says: what was asked for, of which image, and which picture of it."""

    entrance: ImageLoader
    job: Job
    formats: tuple[str, ...]
    keep: tuple[str, ...]
    burst: RenditionPlan
    doubt: str  # why the bytes may be others after all; "" where nothing speaks for it


def replay_of(path: Path, inputs: Sequence[Path], max_pixels: int) -> Replay:
    """What a sidecar says, where it can be done again.

    Args:
        path: of the sidecar.
        inputs: where its input is now, or none, where it was.
        max_pixels: as for :class:`clpipe.images.read.ReadOptions`.

    Raises:
        RequestError: it is no sidecar, or one of another version, or the input or a file that was
            used (a camera profile, a curve, a stage) is not there or has changed.
    """
    if len(inputs) > 1:
        raise RequestError(f"{path}: it has one input; found {len(inputs)}")
    try:
        found = read_sidecar(path)
    except FileNotFoundError:
        raise RequestError(f"{path}: no such file") from None
    except ImageError:
        raise RequestError(f"{path}: clpipe did not write this file; a sidecar is wanted") from None
    if found["clpipe"] != __version__:
        raise RequestError(
            f"{path}: it is of clpipe {found['clpipe']}, and this is {__version__}, which "
            "may make other bytes; install that version, or run it anew"
        )
    try:
        replay = _replay(found, inputs, max_pixels)
        files = dict(found["asked"]["files"])
        digest = str(found["sha256"])
    except (KeyError, TypeError, ValueError, AttributeError, RequestError) as error:
        raise RequestError(f"{path}: it is damaged: {error}") from None
    for name, was in {**files, str(replay.job.path): digest}.items():
        now = digests([name]).get(name)
        if now is None:
            raise RequestError(f"{path}: {name}: cannot be read, and was used")
        if now != was:
            raise RequestError(
                f"{path}: {name}: has changed since (SHA-256 {now[:12]}..., was {was[:12]}...), so "
                "the picture would be another one"
            )
    return replay


def _replay(found: dict[str, Any], inputs: Sequence[Path], max_pixels: int) -> Replay:
    asked, picture = found["asked"], str(found["picture"])
    own = request_from_record(asked)
    reading = ReadOptions(asked["layer"], max_pixels, asked["transfer"])
    check_output_name(str(found["name"]))
    frames = found["frames"]
    burst = RenditionPlan(frames, tuple(filter(None, [truth_named(picture)])))
    formats = tuple(asked["formats"])
    if not set(formats) <= set(EVERY_FORMAT) or not (frames is None or frames > 0):
        raise RequestError(f"found formats {', '.join(map(str, formats))} and frames {frames}")
    if picture not in burst.names():
        raise RequestError(f"found picture {picture!r}")
    job = Job(
        inputs[0] if inputs else Path(found["input"]),
        own.image_key,
        str(found["name"]),
        values=own.row,
        pictures=(picture,),
    )
    were = found["versions"]
    other = [
        f"{name} {were.get(name)}" for name, now in all_versions().items() if were[name] != now
    ]
    doubt = f"was made with {', '.join(other)}; the bytes may be others" if other else ""
    return Replay(ImageLoader(own, reading), job, formats, tuple(asked["keep"]), burst, doubt)
