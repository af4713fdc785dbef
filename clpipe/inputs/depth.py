"""The depth that a step needs: found in an image's file or beside it."""

import os
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from clpipe.base.digests import digests, stamp_of
from clpipe.base.errors import ImageError
from clpipe.base.reading import unchanged
from clpipe.base.types import Array, Floats
from clpipe.chain.carry import AovSpec
from clpipe.chain.chain import Chain
from clpipe.chain.depth import depth_steps
from clpipe.images.passes import read_layer
from clpipe.inputs.companions import Finder, FoundLayer
from clpipe.reference.defocus import Depth, checked_depth
from clpipe.reference.geometry import Margins

USUAL = ("Depth", "Z", "ZDepth", "Distance")  # layers, in the order in which they are looked for


def read_depth(
    path: Path,
    chain: Chain,
    width: int,
    height: int,
    margins: Margins,
    carried: Sequence[AovSpec],
    max_pixels: int,
) -> Depth:
    """The depth of an image.

    Args:
        path: of the image.
        chain: with a step that needs depth.
        width, height: of the image, with its margins.
        margins: how far it goes on beyond the picture.
        carried: layers that go along with it, whose patterns say where it may be.
        max_pixels: a file that claims more is refused before memory is taken.

    Raises:
        ImageError: it is missing, damaged, of another size, NaN or negative.
    """
    step, method = next(iter(depth_steps(chain).items()))
    layer = _find(path, step, method.layer, [each.pattern for each in carried if each.pattern])
    whole, (width, height) = (width, height), margins.inside(width, height)
    with unchanged(layer.file):
        pixels, (x, y), size = read_layer(layer.file, layer.location, max_pixels)
        digest = digests([str(layer.file)]).get(str(layer.file), "")
    if size != (width, height):
        raise ImageError(
            f"{layer.file}: its layer {layer.name} has {size[0]}x{size[1]} pixels, but the picture "
            f"{path} has {width}x{height}; render both at one size"
        )
    try:
        place = x + margins.left, y + margins.top
        depth = checked_depth(_on_image(pixels[..., 0], *place, *whole))
    except ImageError as error:
        raise ImageError(f"{layer.file}: layer {layer.name}: {error}") from None
    length, modified = stamp_of(layer.file)
    record = {
        "layer": layer.name,
        "file": os.path.relpath(layer.file, path.parent),
        "size": length,
        "modified": modified,
        "sha256": digest,
    }
    return Depth(depth, record)


def _find(path: Path, step: str, name: str, patterns: Sequence[str]) -> FoundLayer:
    """The layer of that name; of "" the first of the usual ones that is there."""
    errors = []
    for asked in (name,) if name else USUAL:
        try:
            return Finder(path, patterns).find(AovSpec(asked, "depth"))[0]
        except ImageError as error:
            errors.append(str(error))
    usual = "" if name else f" (nor {', '.join(USUAL[1:])})"
    raise ImageError(
        f"{errors[0].replace('--carry', f'{step} needs depth')}{usual}; name it with "
        f"{step}.layer, or turn {step} off with {step}.method=none"
    )


def _on_image(pixels: Array, x: int, y: int, width: int, height: int) -> Floats:
    """A data window's depth at a place of an image; infinite where there is nothing."""
    if (x, y, *pixels.shape) == (0, 0, height, width):
        return pixels
    whole = np.full((height, width), np.inf, np.float32)
    top, left = max(y, 0), max(x, 0)
    part = pixels[top - y : height - y, left - x : width - x]
    whole[top : top + part.shape[0], left : left + part.shape[1]] = part
    return whole
