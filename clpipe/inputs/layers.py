"""Reads the layer that a step needs, from an image's file or a companion."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from clpipe.base.errors import ImageError
from clpipe.chain.carry import AovSpec
from clpipe.chain.chain import Chain
from clpipe.chain.layers import layer_of, layer_steps
from clpipe.images.pixels import display_window
from clpipe.inputs.carry import file_record, read_source
from clpipe.inputs.companions import LayerFinder, LayerSource
from clpipe.reference.geometry import Margins
from clpipe.stage import ImageLayer


def read_step_layer(
    path: Path,
    picture: str,
    chain: Chain,
    step: str,
    width: int,
    height: int,
    margins: Margins,
    carried: Sequence[AovSpec],
    max_pixels: int,
) -> ImageLayer:
    """Return the layer of an image that a step reads.

    Args:
        path: the image file.
        picture: the name of the layer that contains the picture.
        chain: the chain of the image.
        step: the name of the step.
        width: the width of the image with its overscan, in px.
        height: its height with its overscan, in px.
        margins: the overscan on each side.
        carried: the carried layers. Their patterns name companions that are searched as well.
        max_pixels: a file with more pixels is rejected before it is read.

    Raises:
        ImageError: the layer is missing, damaged, of another size, or has values that the step
            cannot use.
        RequestError: as for :func:`~clpipe.chain.layers.layer_of`.
    """
    patterns = [each.pattern for each in carried if each.pattern]
    found = _find(path, picture, chain, step, patterns)
    layer = read_source(found, path, margins, (width, height), max_pixels)
    # The first vector is that to the frame before.
    channels, signs = layer.vectors[0] if layer.vectors else ((0,), (1,))
    samples = layer.pixels[..., list(channels)] * np.array(signs, np.float32)
    outside = np.nan if layer.vectors else np.inf
    window = display_window(samples, layer.x, layer.y, width, height, outside)
    record = {"layer": found.name, **file_record(path, found.file)}
    try:
        return layer_of(chain, step, window, record)
    except ImageError as error:
        raise ImageError(f"{found.file}: layer {found.name}: {error}") from None


def _find(
    path: Path, picture: str, chain: Chain, step: str, patterns: Sequence[str]
) -> LayerSource:
    """Return the layer that a step names, or the first of its usual layers that exists."""
    method = layer_steps(chain)[step]
    name, _, pattern = method.layer.partition("=")
    errors = []
    for layer_name in (name,) if name else method.usual_layers:
        try:
            finder = LayerFinder(path, [pattern] if pattern else patterns, picture)
            return finder.find(AovSpec(layer_name, method.layer_kind))[0]
        except ImageError as error:
            errors.append(str(error))
    others = "" if name else ", ".join(method.usual_layers[1:])
    searched = f" (clpipe also looked for {others})" if others else ""
    message = errors[0].partition("; choose another kind")[0]
    message = message.replace("--carry:", f"{step} needs {method.layer_kind}:")
    message = message.replace("--carry ", f"{step}.layer=")
    plain = chain.step_named(step).stage.methods[0].method
    raise ImageError(
        f"{message}{searched}; to use another layer, set {step}.layer; to use none, set "
        f"{step}.method={plain}"
    )
