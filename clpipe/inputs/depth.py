"""The depth that a step needs: found in an image's file or beside it."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from clpipe.base.errors import ImageError
from clpipe.chain.carry import AovSpec
from clpipe.chain.chain import Chain
from clpipe.chain.depth import depth_steps
from clpipe.images.pixels import display_window
from clpipe.inputs.carry import file_record, read_found
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
    pixels, (x, y) = read_found(layer, path, margins.inside(width, height), max_pixels)
    place = x + margins.left, y + margins.top
    depths = pixels[..., :1].astype(np.float32)
    window = display_window(depths, *place, width, height, outside=np.inf)
    try:
        depth = checked_depth(window[..., 0])
    except ImageError as error:
        raise ImageError(f"{layer.file}: layer {layer.name}: {error}") from None
    return Depth(depth, {"layer": layer.name, **file_record(path, layer.file)})


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
