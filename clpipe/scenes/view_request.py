"""Converts the command line's choice of views to the request for Blender."""

import math
from collections.abc import Mapping, Sequence
from pathlib import Path, PurePosixPath
from typing import Any

from clpipe.base.errors import RequestError
from clpipe.base.text import whole_number
from clpipe.inputs.render_cameras import read_views

PATHS = ("orbit", "arc", "random")
DEFAULT_VIEWS = 24
MAX_SIDE = 2**16  # px, the longer side of a render
LAST_FRAME = 2**20 - 2  # the largest frame number in Blender


def requested_views(
    views: int | None,
    path: str | None,
    box: Sequence[float] | None,
    frames: Sequence[int] | None,
    poses: Path | None,
    seed: int,
) -> dict[str, Any]:
    """Return the request for views, see :class:`clpipe.scenes.blender.Rendering`.

    Args:
        views: the number of generated views; None is :data:`DEFAULT_VIEWS`, unless there are frames
            or poses.
        path: one of :data:`PATHS`; None is the first.
        box: two corners of a box, for random places.
        frames: numbers of frames of the scene.
        poses: a file with cameras.
        seed: the seed of random places.

    Raises:
        RequestError: more than one source of views is given, or a file of cameras is wrong.
    """
    generated = views is not None or path is not None or box is not None
    kinds = {"--views, --path and --box": generated, "--frames": frames, "--poses": poses}
    if len(sources := [name for name, is_asked in kinds.items() if is_asked]) > 1:
        raise RequestError(
            f"found {' and '.join(sources)}; each of them sets the views, so use only one"
        )
    if box is not None and path != "random":
        raise RequestError("--box: this option needs --path random; add it, or remove --box")
    if frames:
        return {"frames": list(frames)}
    if poses:
        return {"cameras": cameras_of(poses)}
    box = None if box is None else list(box)
    return {"path": path or PATHS[0], "count": views or DEFAULT_VIEWS, "seed": seed, "box": box}


def cameras_of(poses: Path) -> list[dict[str, Any]]:
    """Return a record for each view of a file: name, width, height, K, R and t.

    Raises:
        RequestError: the file cannot be read, a view is incomplete, or two views have one name.
    """
    records: dict[str, dict[str, Any]] = {}
    for view in read_views(poses):
        values, name = view.values, PurePosixPath(view.name.replace("\\", "/")).stem
        if view.problem:
            raise RequestError(f"--poses {poses}: view {view.name}: {view.problem}")
        if view.size is None or not {"fx", "rotation"} <= values.keys():
            raise RequestError(
                f"--poses {poses}: view {view.name}: width, height, focal length or pose is "
                "missing; add it"
            )
        if name in records:
            raise RequestError(f"--poses {poses}: two views are called {name}; rename one")
        width, height = view.size
        fx = values["fx"]
        fy, cx = values.get("fy", fx), values.get("cx", width / 2)
        matrix = [[fx, 0.0, cx], [0.0, fy, values.get("cy", height / 2)], [0.0, 0.0, 1.0]]
        place = {"R": values["rotation"], "t": values["translation"]}
        records[name] = {"name": name, "width": width, "height": height, "K": matrix, **place}
    return list(records.values())


def dependencies(views: Mapping[str, Any]) -> Any:
    """Return the values on which renders of views depend. A frame does not depend on others."""
    return "frames" if "frames" in views else views


def parse_frames(text: str) -> list[int]:
    """Return the numbers of frames in a text.

    >>> parse_frames("1-4, 9")
    [1, 2, 3, 4, 9]

    Raises:
        RequestError: the text contains no frames.
    """
    frames: dict[int, None] = {}
    for part in text.split(","):
        begin, _, end = part.strip().partition("-")
        first, last = whole_number(begin), whole_number(end or begin)
        if not (0 <= first <= LAST_FRAME and 0 <= last <= LAST_FRAME):
            raise RequestError(
                f"--frames: found {text!r}; expected frames, such as 1-24 or 1,5,9, each from 0 to "
                f"{LAST_FRAME}"
            )
        frames |= dict.fromkeys(range(first, last + 1))
    if not frames:
        raise RequestError(
            f"--frames: found {text!r}, which contains no frame; expected a range such as 1-24"
        )
    return list(frames)


def parse_resolution(text: str) -> tuple[int, int]:
    """Return the width and height in px in a text.

    >>> parse_resolution("960x640")
    (960, 640)

    Raises:
        RequestError: the text has another form.
    """
    width, height = map(whole_number, text.lower().partition("x")[::2])
    if not (0 < width <= MAX_SIDE and 0 < height <= MAX_SIDE):
        raise RequestError(f"--resolution: found {text!r}; expected WIDTHxHEIGHT, such as 960x640")
    return width, height


def parse_box(text: str) -> list[float]:
    """Return two corners of a box: the lowest x, y and z, then the highest.

    >>> parse_box("-1,-1,0, 1,1,2")
    [-1.0, -1.0, 0.0, 1.0, 1.0, 2.0]

    Raises:
        RequestError: the text has another form.
    """
    try:
        values = [float(part) for part in text.split(",")]
    except ValueError:
        values = []
    if len(values) != 6 or not all(map(math.isfinite, values)):
        raise RequestError(f"--box: found {text!r}; expected two corners, such as -1,-1,0,1,1,2")
    return values
