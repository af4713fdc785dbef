"""Layers of an image, such as its depth, for the steps that read them."""

import weakref
from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np

from clpipe.base.errors import ImageError, RequestError
from clpipe.base.types import Array
from clpipe.chain.chain import Chain, cached_by_structure
from clpipe.chain.registry import all_stages
from clpipe.images.kinds import flow_vectors
from clpipe.reference.carried import Layer, warp
from clpipe.stage import ImageLayer, LayerMethod

# The axes of an array of each kind, and the call that takes one.
ARRAYS = {
    "depth": ("(height, width)", "process(image, key, depth=depth)"),
    "flow": ("(height, width, 2)", "stream(frame, flow=flow) of a clpipe.Stream"),
}


def layer_steps(chain: Chain) -> dict[str, LayerMethod]:
    """Return the methods of the steps that read a layer, by step name."""
    return {s.name: s.method for s in chain.steps if isinstance(s.method, LayerMethod)}


def reader_of(kind: str) -> str:
    """Return a setting that makes a chain read a layer of a kind, such as depth."""
    methods = ((stage, method) for stage in all_stages().values() for method in stage.methods)
    readers = ((s, m) for s, m in methods if issubclass(m, LayerMethod) and m.layer_kind == kind)
    stage, method = next(readers)
    return f"{stage.name}.method={method.method}"


@cached_by_structure
def reads_layers(chain: Chain) -> bool:
    """Return whether a step of a chain reads a layer of the image."""
    return bool(layer_steps(chain))


def layer_of(
    chain: Chain, step: str, pixels: Array, record: Mapping[str, Any] | None = None
) -> ImageLayer:
    """Return a layer of an image in the form that a step reads.

    Args:
        chain: the chain.
        step: the name of the step.
        pixels: the layer, (height, width, channel), of the size of the image.
        record: its source, for a sidecar.

    Returns:
        The layer. If earlier steps move pixels, flow is warped like the image.

    Raises:
        ImageError: the layer has values that the step cannot use.
        RequestError: an earlier step moves pixels, which would misalign depth.
    """
    method, before = layer_steps(chain)[step], chain.up_to([step])
    if before.geometry and method.layer_kind == "depth":
        name = next(each.name for each in before.steps if each.method.geometry())
        raise RequestError(
            f"stages: {name} moves pixels before {step}, but does not move the depth that {step} "
            f"needs; list {name} after {step}"
        )
    if before.geometry:
        layer = Layer(method.layer_kind, pixels, vectors=flow_vectors("", ("X", "Y")))
        (warped,), valid = warp([layer], before.geometry, *pixels.shape[1::-1])
        pixels = np.where(valid[..., None] > 0, warped, np.nan)
    return ImageLayer(method.layer_kind, method.parse_layer(pixels), record or {})


def with_layers(chain: Chain, layers: Mapping[str, ImageLayer]) -> Chain:
    """Return the chain with the layers that its steps read, by step name.

    The chain holds weak references, so the caller must keep ``layers`` alive. Plans and kernels do
    not change.
    """
    steps = tuple(
        replace(step, context=step.context.replace(layer=weakref.ref(layers[step.name])))
        if step.name in layers
        else step
        for step in chain.steps
    )
    return replace(chain, steps=steps)


def layer_warnings(chain: Chain, layers: Mapping[str, ImageLayer]) -> list[str]:
    """Return the warnings of the steps about the layers that they read.

    Raises:
        RequestError: a step cannot use its layer.
    """
    methods = layer_steps(chain)
    found = {name: methods[name].check_layer(layer) for name, layer in layers.items()}
    return [f"{name}: {text}" for name, text in found.items() if text]


def layer_of_array(
    chain: Chain, step: str, pixels: Array | None, width: int, height: int
) -> ImageLayer:
    """Return the layer that a step reads, from an array.

    Args:
        chain: the chain.
        step: the name of the step.
        pixels: the layer, (height, width), or for flow (height, width, 2).
        width: the width of the image in px.
        height: its height in px.

    Raises:
        ImageError: the array is missing, has another shape, or has values that the step cannot use.
        RequestError: as for :func:`layer_of`.
    """
    kind = layer_steps(chain)[step].layer_kind
    axes, call = ARRAYS[kind]
    if pixels is None:
        raise ImageError(f"{step} needs {kind}, {axes}, but none was passed; call {call}")
    if np.shape(pixels) != (height, width, 2)[: axes.count(",") + 1]:
        raise ImageError(
            f"found {kind} of shape {np.shape(pixels)}, but the image has {(height, width)}; pass "
            f"{kind}, {axes}, of the image's height and width"
        )
    return layer_of(chain, step, np.reshape(pixels, (height, width, -1)))
