"""Layers that go along with a picture, as they are asked for."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import cast, get_args

from clpipe.base.errors import RequestError
from clpipe.base.text import one_of
from clpipe.images.kinds import kind_named
from clpipe.reference.carried import LayerKind

VALID = "valid"  # the channel that says which pixels are known


PNG = "png"  # a kind: depth or labels, which are written as a PNG, too


@dataclass(frozen=True)
class AovSpec:
    """A layer to carry.

    Args:
        name: what it is called.
        kind: what it holds; None where only the file may say that.
        pattern: of the name of the file that holds it; "" is one of the usual names.
        png: whether it is depth, or labels, that are written as a PNG, too.
    """

    name: str
    kind: LayerKind | None
    pattern: str = ""
    png: bool = False


def parse_carry(texts: Sequence[str]) -> tuple[AovSpec, ...]:
    """Layers from texts of the form NAME[:KIND][=PATTERN].

    >>> parse_carry(["Depth", "nn:normal"])[1]
    AovSpec(name='nn', kind='normal', pattern='', png=False)
    >>> parse_carry(["Z:png=../z/{name}.exr"])
    (AovSpec(name='Z', kind='depth', pattern='../z/{name}.exr', png=True),)

    Raises:
        RequestError: a name is empty, cannot be a part of a file's name, or is there twice, a kind
            does not exist, or a pattern has no place for the image's name.
    """
    kinds = (*get_args(LayerKind), PNG)
    found: dict[str, AovSpec] = {}
    for text in texts:
        layer, equals, pattern = text.partition("=")
        name, colon, kind = layer.rpartition(":")
        name, kind = (name, kind) if colon else (layer, "")
        if colon and kind not in kinds:
            raise RequestError(f"--carry {text}: {one_of('kind', kind, kinds)}")
        if not name or not name.isprintable() or "/" in name or name.lower() == VALID:
            raise RequestError(
                f"--carry {text!r}: it is the name of a layer, such as Depth, and not {VALID}"
            )
        if equals and ("{name}" not in pattern or "\0" in pattern):
            raise RequestError(
                f"--carry {text!r}: its pattern has no {{name}}, which stands for the image's name "
                "without its ending, as in 'Depth={name}_depth.exr' or 'Depth=../depth/{name}.exr'"
            )
        if name.lower() in found:
            raise RequestError(f"--carry {name}: it is there twice")
        own = kind_named(name)
        known = (own if own == "label" else "depth") if kind == PNG else kind or own
        found[name.lower()] = AovSpec(name, cast("LayerKind | None", known), pattern, kind == PNG)
    return tuple(found.values())
