"""Types, limits and errors that the readers of COCO, KITTI and BOP annotations share."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NoReturn

from clpipe.base.errors import RequestError
from clpipe.base.reading import parse_json, read_named

MAX_BYTES = 1 << 30  # bytes; the largest file
MAX_COORDINATE = 1e5  # px, inside or outside the render
MAX_PIXELS = 10**10  # pixels of a render: MAX_COORDINATE squared

Record = dict[str, Any]


@dataclass(frozen=True)
class AnnotatedRender:
    """The annotations of one render.

    Args:
        name: the render's file name in the annotations.
        size: width and height in px; None if the format does not state them.
        content: the annotations, in a type that depends on the format.
    """

    name: str
    size: tuple[int, int] | None
    content: Any


@dataclass(frozen=True)
class Annotations:
    """The annotations of several renders, in any supported format.

    Args:
        file: the file or folder that they were read from.
        renders: the annotated renders.
    """

    file: Path
    renders: Sequence[AnnotatedRender]


def read_json(path: Path) -> Any:
    """Return the values of a JSON file.

    Raises:
        RequestError: the file cannot be read, or is not JSON.
    """
    text = read_named("--annotations", path, MAX_BYTES)
    try:
        return parse_json(text)
    except ValueError as error:
        raise RequestError(
            f"--annotations {path}: this is not valid JSON ({error}); give COCO's .json, BOP's "
            "scene_gt.json, or a folder of KITTI labels"
        ) from None


def are_numbers(values: Any, count: int | None = None) -> bool:
    """Return whether a value is a list of coordinates; None allows any count."""
    return (
        isinstance(values, list)
        and count in (None, len(values))
        and all(type(v) in (int, float) and abs(v) <= MAX_COORDINATE for v in values)
    )


def reject(path: Path, place: str, found: Any, expected: str) -> NoReturn:
    """Reject a value of an annotation file.

    Args:
        path: the file.
        place: where the value is in the file.
        found: the value.
        expected: what is allowed, in words.

    Raises:
        RequestError: always.
    """
    text = str(found)
    raise RequestError(f"--annotations {path}: {place}: found {text[:100]}; expected {expected}")
