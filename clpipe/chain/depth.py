"""Chains that need the depth of their image: which steps do, and how they get it."""

import weakref
from dataclasses import replace

import numpy as np

from clpipe.base.errors import ImageError, RequestError
from clpipe.base.types import Array
from clpipe.chain.chain import Chain, of_structure
from clpipe.reference.defocus import Depth, checked_depth
from clpipe.stage import OfDepth


def depth_steps(chain: Chain) -> dict[str, OfDepth]:
    """The methods of the steps of a chain that need depth, by the names of the steps."""
    return {s.name: s.method for s in chain.steps if isinstance(s.method, OfDepth)}


@of_structure
def needs_depth(chain: Chain) -> bool:
    """Whether a step of a chain needs the depth of its image."""
    return bool(depth_steps(chain))


def with_depth(chain: Chain, depth: Depth) -> Chain:
    """The chain with the depth of an image, which must outlive its use there.

    Plans and kernels stay those of the chain.

    Raises:
        RequestError: pixels were moved before, and depth was not.
    """
    reference = weakref.ref(depth)
    needing = depth_steps(chain)
    names = [step.name for step in chain.steps]
    for step in chain.steps[: max(map(names.index, needing))]:
        if step.method.geometry():
            raise RequestError(
                f"stages: {step.name} moves pixels before {[*needing][-1]}, whose depth stays "
                "where it is; put it behind"
            )
    steps = tuple(
        replace(step, context=step.context.but(depth=reference)) if step.name in needing else step
        for step in chain.steps
    )
    return replace(chain, steps=steps)


def warnings_of(chain: Chain, depth: Depth) -> list[str]:
    """Warnings of the steps that need depth, about that of an image.

    Raises:
        RequestError: one cannot use it.
    """
    found = {name: method.check_depth(depth) for name, method in depth_steps(chain).items()}
    return [f"{name}: {text}" for name, text in found.items() if text]


def depth_of_array(pixels: Array | None, width: int, height: int) -> Depth:
    """Depth that somebody gives with an image of that size.

    Raises:
        ImageError: it is missing, of another size, or no depth.
    """
    if pixels is None:
        raise ImageError("the chain needs depth, (height, width): process(image, key, depth=depth)")
    found = np.shape(pixels)
    if found != (height, width):
        raise ImageError(f"found depth of shape {found}; the image's is {(height, width)}")
    return Depth(checked_depth(pixels))
