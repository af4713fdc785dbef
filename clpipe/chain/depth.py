"""Chains that need the depth of their image: which steps do, and how they get it."""

import weakref
from dataclasses import replace

import numpy as np

from clpipe.base.errors import ImageError, RequestError
from clpipe.base.types import Array
from clpipe.chain.chain import Chain
from clpipe.reference.defocus import Depth, checked_depth
from clpipe.stages.defocus import ThinLens


def lenses_of(chain: Chain) -> dict[str, ThinLens]:
    """The steps of a chain that need depth, by their names."""
    return {s.name: s.method for s in chain.steps if isinstance(s.method, ThinLens)}


def with_depth(chain: Chain, depth: Depth) -> Chain:
    """The chain with the depth of an image, which must outlive its use there.

    Plans and kernels stay those of the chain.

    Raises:
        RequestError: pixels were moved before, and depth was not.
    """
    reference = weakref.ref(depth)
    lenses = lenses_of(chain)
    names = [step.name for step in chain.steps]
    for step in chain.steps[: max(map(names.index, lenses))]:
        if step.method.geometry():
            raise RequestError(
                f"stages: {step.name} moves pixels before {[*lenses][-1]}, whose depth stays where "
                "it is; put it behind"
            )
    steps = tuple(
        replace(step, context=replace(step.context, depth=reference))
        if step.name in lenses
        else step
        for step in chain.steps
    )
    return replace(chain, steps=steps)


def warnings_of(chain: Chain, depth: Depth) -> list[str]:
    """What is to be said of an image's discs: how many are larger than they may be."""
    found = []
    for name, lens in lenses_of(chain).items():
        radii = abs(lens.radii(depth.pixels))
        if count := np.count_nonzero(radii > lens.max_radius):
            found.append(
                f"{name}: {count} of {radii.size} pixels are spread over radii up to "
                f"{radii.max():.1f} px; {name}.max_radius makes them {lens.max_radius} px"
            )
    return found


def depth_of_array(pixels: Array | None, width: int, height: int) -> Depth:
    """Depth that somebody gives with an image of that size.

    Raises:
        ImageError: it is missing, of another size, or no depth.
    """
    if pixels is None:
        raise ImageError("defocus needs depth, (height, width): process(image, key, depth=depth)")
    found = np.shape(pixels)
    if found != (height, width):
        raise ImageError(f"found depth of shape {found}; the image's is {(height, width)}")
    return Depth(checked_depth(pixels))
