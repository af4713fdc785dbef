"""White balance by gray world: the mean colour of a scene is grey."""

from typing import ClassVar

import numpy as np

from clpipe.base.types import Floats
from clpipe.reference.cfa import Pattern, by_site
from clpipe.stage import Arguments, Context, Pass, Reduction
from clpipe.stages.white_balance.gains import LIGHTS, EstimatedGains


class GrayWorld(EstimatedGains):
    """The gain of a colour c is mean(G) / mean(c) (Buchsbaum, J. Franklin Institute 1980).

    Samples are clipped to -1..1 and summed as integers in steps of 2^-20, so the sums are exact and
    do not depend on order.
    """

    method: ClassVar = "gray_world"
    kernel: ClassVar = "gray_world"
    summary: ClassVar = "make the means of the three colours equal"

    def estimation_pass(self) -> Pass:
        find = Reduction("gray_world", ("red_gain", "blue_gain"), ("pattern", *LIGHTS))
        return Pass("gray_world_sample", find)

    def arguments(self, context: Context) -> Arguments:
        return {**super().arguments(context), "pattern": context.cfa}

    def gains(self, image: Floats, pattern: Pattern) -> tuple[np.float32, np.float32]:
        return gray_world_gains(image, pattern)


def gray_world_gains(image: Floats, pattern: Pattern) -> tuple[np.float32, np.float32]:
    """Return mean(G) / mean(R) and mean(G) / mean(B) of a (height, width) mosaic.

    A gain is 1 if the mean of its colour or of green is not above 0.

    >>> gray_world_gains(np.float32([[0.125, 0.25], [0.5, 0.75]]), "RGGB")
    (np.float32(3.0), np.float32(0.5))
    """
    steps = np.rint(np.clip(image, np.float32(-1), np.float32(1)) * np.float32(2**20))
    site = by_site(image.shape, pattern, np.float32(0), np.float32(1), np.float32(2))
    samples = [steps[site == colour].astype(np.int64) for colour in range(3)]
    red, green, blue = ((int(s.sum()), s.size) for s in samples)

    def gain(colour: tuple[int, int]) -> np.float32:
        if green[0] <= 0 or colour[0] <= 0:
            return np.float32(1)
        mean_green = np.float32(green[0]) / np.float32(green[1])
        return mean_green / (np.float32(colour[0]) / np.float32(colour[1]))

    return gain(red), gain(blue)
