"""Depth for the chains whose steps need it."""

import weakref
from dataclasses import replace

import numpy as np

from clpipe.base.errors import ImageError, RequestError
from clpipe.base.types import Array
from clpipe.chain.chain import Chain, cached_by_structure
from clpipe.reference.defocus import Depth, parse_depth
from clpipe.stage import DepthMethod


def depth_steps(chain: Chain) -> dict[str, DepthMethod]:
    """Return the methods of the steps that need depth, by step name."""
    return {s.name: s.method for s in chain.steps if isinstance(s.method, DepthMethod)}


@cached_by_structure
def needs_depth(chain: Chain) -> bool:
    """Return whether a step of a chain needs the image's depth."""
    return bool(depth_steps(chain))


def with_depth(chain: Chain, depth: Depth) -> Chain:
    """Return the chain with the depth of an image.

    The chain holds a weak reference, so the caller must keep ``depth`` alive. Plans and kernels do
    not change.

    Raises:
        RequestError: an earlier step moves pixels, which would misalign the depth.
    """
    reference = weakref.ref(depth)
    methods = depth_steps(chain)
    names = [step.name for step in chain.steps]
    for step in chain.steps[: max(map(names.index, methods))]:
        if step.method.geometry():
            raise RequestError(
                f"stages: {step.name} moves pixels before {[*methods][-1]}, but does not move the "
                f"depth that {[*methods][-1]} needs; list {step.name} after {[*methods][-1]}"
            )
    steps = tuple(
        replace(step, context=step.context.replace(depth=reference))
        if step.name in methods
        else step
        for step in chain.steps
    )
    return replace(chain, steps=steps)


def depth_warnings(chain: Chain, depth: Depth) -> list[str]:
    """Return the warnings of the steps that need depth about an image's depth.

    Raises:
        RequestError: a step cannot use this depth.
    """
    found = {name: method.check_depth(depth) for name, method in depth_steps(chain).items()}
    return [f"{name}: {text}" for name, text in found.items() if text]


def depth_of_array(pixels: Array | None, width: int, height: int) -> Depth:
    """Return the depth for an image of that size in px, from an array, (height, width).

    Raises:
        ImageError: the array is missing, has another shape, or holds no depth.
    """
    if pixels is None:
        raise ImageError(
            "the chain needs depth, (height, width), but none was passed; call "
            "process(image, key, depth=depth)"
        )
    found = np.shape(pixels)
    if found != (height, width):
        raise ImageError(
            f"found depth of shape {found}, but the image has {(height, width)}; pass depth of the "
            "image's height and width"
        )
    return Depth(parse_depth(pixels))
