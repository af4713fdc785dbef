"""Reads the depth that a step needs, from an image's file or a companion."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from clpipe.base.errors import ImageError
from clpipe.chain.carry import AovSpec
from clpipe.chain.chain import Chain
from clpipe.chain.depth import depth_steps
from clpipe.images.pixels import display_window
from clpipe.inputs.carry import file_record, read_layer_samples
from clpipe.inputs.companions import LayerFinder, LayerSource
from clpipe.reference.defocus import Depth, parse_depth
from clpipe.reference.geometry import Margins

DEFAULT_LAYERS = ("Depth", "Z", "ZDepth", "Distance")  # names of layers, in order of preference


def read_depth(
    path: Path,
    chain: Chain,
    width: int,
    height: int,
    margins: Margins,
    carried: Sequence[AovSpec],
    max_pixels: int,
) -> Depth:
    """Return the depth of an image, as float32 in metres, (height, width).

    Args:
        path: the image file.
        chain: a chain with a step that needs depth.
        width, height: size of the image with its overscan, in px.
        margins: the overscan on each side.
        carried: the carried layers. Their patterns name companions that are searched as well.
        max_pixels: a file with more pixels is rejected before it is read.

    Raises:
        ImageError: the depth is missing, damaged, of another size, NaN or negative.
    """
    step, method = next(iter(depth_steps(chain).items()))
    layer = _find(path, step, method.layer, [each.pattern for each in carried if each.pattern])
    pixels, (x, y) = read_layer_samples(layer, path, margins.frame_size(width, height), max_pixels)
    place = x + margins.left, y + margins.top
    depths = pixels[..., :1].astype(np.float32)
    window = display_window(depths, *place, width, height, outside=np.inf)
    try:
        depth = parse_depth(window[..., 0])
    except ImageError as error:
        raise ImageError(f"{layer.file}: layer {layer.name}: {error}") from None
    return Depth(depth, {"layer": layer.name, **file_record(path, layer.file)})


def _find(path: Path, step: str, name: str, patterns: Sequence[str]) -> LayerSource:
    """Return the layer called ``name``, or for "" the first of the default layers that exists."""
    errors = []
    for layer_name in (name,) if name else DEFAULT_LAYERS:
        try:
            return LayerFinder(path, patterns).find(AovSpec(layer_name, "depth"))[0]
        except ImageError as error:
            errors.append(str(error))
    searched = "" if name else f" ({', '.join(DEFAULT_LAYERS[1:])} were looked for as well)"
    message = errors[0].replace("--carry", f"{step} needs depth")
    raise ImageError(
        f"{message}{searched}; to use another layer, set {step}.layer; to turn {step} off, set "
        f"{step}.method=none"
    )
