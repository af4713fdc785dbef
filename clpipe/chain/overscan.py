"""Chains whose image goes on beyond the picture, where a lens shows what a render has there.

The stages up to the first one that moves pixels work on the whole image, and that one makes the
picture of it. Where it is no lens, or a stage before it cannot do so, the image is the picture.
"""

from collections.abc import Sequence
from dataclasses import replace

from clpipe.base.errors import ImageError
from clpipe.base.types import Array
from clpipe.chain.chain import Chain, of_structure
from clpipe.reference.geometry import NO_MARGINS, Margins


@of_structure
def steps_of_overscan(chain: Chain) -> int:
    """How many steps of a chain get an image that goes on beyond the picture; 0 is none."""
    for count, step in enumerate(chain.steps, 1):
        if step.passes and not step.method.overscan:
            return 0
        if step.method.geometry():
            return count
    return 0


def with_overscan(chain: Chain, margins: Margins) -> Chain:
    """The chain for an image that goes on beyond the picture, of which it can make use.

    Plans and kernels differ from those of the chain in numbers alone.
    """
    count = steps_of_overscan(chain)
    steps = tuple(
        replace(step, method=step.method.with_margins(margins)) if number < count else step
        for number, step in enumerate(chain.steps)
    )
    return replace(chain, steps=steps, margins=margins)


def margins_of_array(overscan: Sequence[int], image: Array) -> Margins:
    """The margins that somebody gives with an image, (height, width[, channel]).

    Raises:
        ImageError: they are no margins, or leave no picture.
    """
    if not any(overscan):
        return NO_MARGINS
    if len(overscan) == len(NO_MARGINS) and min(overscan) >= 0 and image.ndim > 1:
        margins = Margins(*map(int, overscan))
        if min(margins.inside(*image.shape[1::-1])) > 0:
            return margins
    raise ImageError(
        f"found overscan {tuple(overscan)}; expected px to the left, at the top, to the right and "
        f"at the bottom, which leave something of an image of shape {image.shape}"
    )
