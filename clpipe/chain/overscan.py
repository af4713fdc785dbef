"""Chains for images with overscan: pixels outside the picture that lens distortion can show.

The stages up to the first one that moves pixels work on the whole image, and that stage makes the
picture from it. If an earlier stage does not support overscan, the image is cropped first.
"""

from collections.abc import Sequence
from dataclasses import replace

from clpipe.base.errors import ImageError
from clpipe.base.types import Array
from clpipe.chain.chain import Chain, cached_by_structure
from clpipe.reference.geometry import NO_MARGINS, Margins


@cached_by_structure
def overscan_step_count(chain: Chain) -> int:
    """Return how many steps of a chain get an image with overscan; 0 if the chain cannot use it."""
    for count, step in enumerate(chain.steps, 1):
        if step.passes and not step.method.overscan:
            return 0
        if step.method.geometry():
            return count
    return 0


def with_overscan(chain: Chain, margins: Margins) -> Chain:
    """Return the chain for an image with overscan, which the chain must be able to use.

    Plans and kernels differ from the ones for ``chain`` only in numbers.
    """
    steps = chain.steps[: overscan_step_count(chain)]
    moved = chain.with_methods({step.name: step.method.with_margins(margins) for step in steps})
    return replace(moved, margins=margins)


def margins_of_array(overscan: Sequence[int], image: Array) -> Margins:
    """Return the margins of an image, (height, width[, channel]), from numbers of px.

    Raises:
        ImageError: the numbers are no margins, or leave no picture.
    """
    if not isinstance(overscan, Sequence):
        overscan = (overscan,)
    if not any(overscan):
        return NO_MARGINS
    if len(overscan) == len(NO_MARGINS) and min(overscan) >= 0 and image.ndim > 1:
        margins = Margins(*map(int, overscan))
        if min(margins.frame_size(*image.shape[1::-1])) > 0:
            return margins
    raise ImageError(
        f"found overscan {tuple(overscan)}; expected four numbers of px (left, top, right, bottom) "
        f"that leave a picture of an image of shape {image.shape}"
    )
