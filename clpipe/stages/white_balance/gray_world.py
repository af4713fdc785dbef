"""Gray world."""

from collections.abc import Mapping
from typing import ClassVar

import numpy as np

from clpipe.reference.cfa import red_site
from clpipe.stage import Access, Argument, Context, Frame, Method, Pass
from clpipe.stages.white_balance.gains import balanced, with_expected_gains
from clpipe.types import Floats


class GrayWorld(Method):
    """k_c = mean(G) / mean(c) (Buchsbaum, J. Franklin Institute 1980).

    Samples are clipped to -1..1 and summed as integers in steps of 2^-20, so the sums are exact.
    """

    method: ClassVar = "gray_world"
    kernel: ClassVar = "gray_world"
    summary: ClassVar = "make the means of the three colours equal"
    tolerance: ClassVar = 1e-6  # of the gains: division is not exact on every device

    def after(self, context: Context) -> Context:
        return with_expected_gains(context)

    def passes(self) -> tuple[Pass, ...]:
        gains = ("red_gain", "blue_gain")
        return (
            Pass(
                "gray_world_sample",
                Access.SUMS,
                finish="gray_world",
                finish_arguments=("pattern",),
                found=gains,
            ),
            Pass("white_balance", arguments=("pattern", *gains), cheap=True),
        )

    def arguments(self, context: Context) -> Mapping[str, Argument]:
        return {"pattern": context.cfa}

    def reference(self, image: Floats, frame: Frame) -> Floats:
        steps = np.rint(np.clip(image, np.float32(-1), np.float32(1)) * np.float32(2**20))
        red_x, red_y = red_site(frame.context.pattern)

        def total(x: int, y: int) -> tuple[int, int]:
            samples = steps[y::2, x::2]
            return int(samples.astype(np.int64).sum()), samples.size

        red, blue = total(red_x, red_y), total(1 - red_x, 1 - red_y)
        green1, green2 = total(1 - red_x, red_y), total(red_x, 1 - red_y)
        green = (green1[0] + green2[0], green1[1] + green2[1])

        def mean(colour: tuple[int, int]) -> np.float32:
            return np.float32(colour[0]) / np.float32(colour[1])

        def gain(colour: tuple[int, int]) -> np.float32:
            if green[0] <= 0 or colour[0] <= 0:
                return np.float32(1)
            return mean(green) / mean(colour)

        frame.found["red_gain"], frame.found["blue_gain"] = float(gain(red)), float(gain(blue))
        return balanced(image, frame.context, gain(red), gain(blue))
