"""Annotations of renders, in the format that a file or a folder is of."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NoReturn, Protocol

from clpipe.base.errors import RequestError
from clpipe.base.reading import parse_json, read_named

LARGEST = 1 << 30  # bytes of a file

FARTHEST = 1e5  # px from the corner of a render, of a place in it or beside it

MOST_PIXELS = 10**10  # of a render, as FARTHEST squared

Record = dict[str, Any]


@dataclass(frozen=True)
class AnnotatedRender:
    """What is annotated of a render.

    Args:
        name: of its file, as the annotations have it.
        size: width and height in px; None where they do not say it.
        content: of the format.
    """

    name: str
    size: tuple[int, int] | None
    content: Any


class Annotations(Protocol):
    """Annotations of renders, of some format."""

    @property
    def file(self) -> Path:
        """Where they are from."""
        ...

    @property
    def renders(self) -> Sequence[AnnotatedRender]:
        """All renders that they name."""
        ...


def parsed(path: Path) -> Any:
    """The values of a JSON file.

    Raises:
        RequestError: it cannot be read, or is no JSON.
    """
    text = read_named("--annotations", path, LARGEST)
    try:
        return parse_json(text)
    except ValueError as error:
        raise RequestError(f"--annotations {path}: no valid JSON ({error})") from None


def refuse(path: Path, place: str, found: Any, expected: str) -> NoReturn:
    """Refuse what a file says somewhere.

    Raises:
        RequestError: always.
    """
    text = str(found)
    raise RequestError(f"--annotations {path}: {place}: found {text[:100]}; expected {expected}")
