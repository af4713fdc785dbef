"""Which layers go along with a picture, as they are asked for."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import get_args

from clpipe.base.errors import RequestError
from clpipe.base.text import one_of
from clpipe.images.kinds import kind_named
from clpipe.reference.carried import LayerKind

VALID = "valid"  # the channel that says which pixels are known


@dataclass(frozen=True)
class Carry:
    """A layer to carry: its name, and what it holds; None where only the file may say that."""

    name: str
    kind: LayerKind | None


def parse_carry(texts: Sequence[str]) -> tuple[Carry, ...]:
    """Layers from texts of the form NAME or NAME:KIND.

    >>> parse_carry(["Depth", "nn:normal"])
    (Carry(name='Depth', kind='depth'), Carry(name='nn', kind='normal'))

    Raises:
        RequestError: a name is empty, cannot be a part of a file's name, or is there twice, or a
            kind does not exist.
    """
    found: dict[str, Carry] = {}
    for text in texts:
        name, colon, kind = text.rpartition(":")
        name, kind = (name, kind) if colon else (text, "")
        if colon and kind not in get_args(LayerKind):
            raise RequestError(f"--carry {text}: {one_of('kind', kind, get_args(LayerKind))}")
        if not name or not name.isprintable() or "/" in name or name.lower() == VALID:
            raise RequestError(
                f"--carry {text!r}: it is the name of a layer, such as Depth, and not {VALID}"
            )
        if name.lower() in found:
            raise RequestError(f"--carry {name}: it is there twice")
        known = next((each for each in get_args(LayerKind) if each == kind), kind_named(name))
        found[name.lower()] = Carry(name, known)
    return tuple(found.values())


def check_companion(pattern: str) -> None:
    """See that a pattern names files beside an image.

    Raises:
        RequestError: it does not.
    """
    if "{name}" not in pattern or "\0" in pattern:
        raise RequestError(
            f"--companion {pattern!r}: it has no {{name}}, which stands for the image's name "
            "without its ending, as in '{name}_depth.exr' or '../depth/{name}.exr'"
        )
