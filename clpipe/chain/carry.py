"""Parse the layers that are warped and written with a picture (--carry)."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import cast, get_args

from clpipe.base.errors import RequestError
from clpipe.base.text import unknown_name
from clpipe.images.kinds import kind_from_name
from clpipe.reference.carried import LayerKind

VALID = "valid"  # the channel that marks known pixels


PNG = "png"  # a kind: depth or labels that are also written as a PNG


@dataclass(frozen=True)
class AovSpec:
    """A layer to carry.

    Args:
        name: the name of the layer.
        kind: the kind of data; None if only the file can tell.
        pattern: the pattern of the file's name; "" stands for the usual names.
        png: whether the layer, depth or labels, is also written as a PNG.
    """

    name: str
    kind: LayerKind | None
    pattern: str = ""
    png: bool = False


def parse_carry(texts: Sequence[str]) -> tuple[AovSpec, ...]:
    """Return the layers for texts of the form NAME[:KIND][=PATTERN].

    >>> parse_carry(["Depth", "nn:normal"])[1]
    AovSpec(name='nn', kind='normal', pattern='', png=False)
    >>> parse_carry(["Z:png=../z/{name}.exr"])
    (AovSpec(name='Z', kind='depth', pattern='../z/{name}.exr', png=True),)

    Raises:
        RequestError: a name is empty, occurs twice, or cannot be part of a file name. Also if a
            kind does not exist, or if a pattern lacks ``{name}``.
    """
    kinds = (*get_args(LayerKind), PNG)
    found: dict[str, AovSpec] = {}
    for text in texts:
        layer, equals, pattern = text.partition("=")
        name, colon, kind = layer.rpartition(":")
        name, kind = (name, kind) if colon else (layer, "")
        if colon and kind not in kinds:
            raise RequestError(f"--carry {text}: {unknown_name('kind', kind, kinds)}")
        if not name or not name.isprintable() or "/" in name or name.lower() == VALID:
            raise RequestError(
                f"--carry {text!r}: found the layer name {name!r}; expected a name such as Depth, "
                f"without '/', and not {VALID}"
            )
        if equals and ("{name}" not in pattern or "\0" in pattern):
            raise RequestError(
                f"--carry {text!r}: the pattern {pattern!r} must contain {{name}}, the name of the "
                "image without its extension; use 'Depth={name}_depth.exr', for example"
            )
        if name.lower() in found:
            raise RequestError(f"--carry {name}: the layer is named twice; name it once")
        own = kind_from_name(name)
        known = (own if own == "label" else "depth") if kind == PNG else kind or own
        found[name.lower()] = AovSpec(name, cast("LayerKind | None", known), pattern, kind == PNG)
    return tuple(found.values())
