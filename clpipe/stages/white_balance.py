"""White balance on the mosaic. What a gain lifts above 1 clips: burnt-out highlights are white."""

from collections.abc import Mapping
from dataclasses import replace
from typing import ClassVar

import numpy as np

from clpipe.reference.cfa import by_site, red_site
from clpipe.stage import Access, Argument, Context, Frame, Kind, Method, Pass, Stage, parameter
from clpipe.types import Floats


def balanced(image: Floats, context: Context, red: np.float32, blue: np.float32) -> Floats:
    """The mosaic with its gains, clipped at white."""
    gains = by_site(image.shape, context.pattern, red, np.float32(1), blue)
    return np.minimum(image * gains, np.float32(1))


class AsShot(Method):
    """The gains that inverse_white_balance took out (none, if it did not run)."""

    method: ClassVar = "as_shot"
    kernel: ClassVar = "site_gains"
    summary: ClassVar = "give back the gains that inverse_white_balance took out"

    red_gain: float | None = parameter(
        None, "Gain of red, green = 1.", auto="as inverse_white_balance used it", gt=0, le=64
    )
    blue_gain: float | None = parameter(
        None, "Gain of blue, green = 1.", auto="as inverse_white_balance used it", gt=0, le=64
    )

    def resolve(self, context: Context) -> "AsShot":
        red, blue = context.gains
        return self.filled(red_gain=red, blue_gain=blue)

    def after(self, context: Context) -> Context:
        assert self.red_gain is not None and self.blue_gain is not None
        return replace(context, applied_gains=(self.red_gain, self.blue_gain))

    def passes(self) -> tuple[Pass, ...]:
        return (Pass("white_balance", arguments=("pattern", "red_gain", "blue_gain"), cheap=True),)

    def arguments(self, context: Context) -> Mapping[str, Argument]:
        red, blue = np.float32(self.red_gain), np.float32(self.blue_gain)
        return {"pattern": context.cfa, "red_gain": red, "blue_gain": blue}

    def reference(self, image: Floats, frame: Frame) -> Floats:
        return balanced(image, frame.context, np.float32(self.red_gain), np.float32(self.blue_gain))


class GrayWorld(Method):
    """k_c = mean(G) / mean(c) (Buchsbaum, J. Franklin Institute 1980).

    Samples are clipped to -1..1 and summed as integers in steps of 2^-20, so the sums are exact.
    """

    method: ClassVar = "gray_world"
    kernel: ClassVar = "gray_world"
    summary: ClassVar = "make the means of the three colours equal"
    tolerance: ClassVar = 1e-6  # of the gains: division is not exact on every device

    def after(self, context: Context) -> Context:
        # What the image will ask for is not known yet; the camera's own gains are the best guess.
        return replace(context, applied_gains=context.gains)

    def passes(self) -> tuple[Pass, ...]:
        gains = ("red_gain", "blue_gain")
        return (
            Pass("gray_world_sample", Access.SUMS, ("pattern",), finish="gray_world", found=gains),
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


STAGE = Stage("white_balance", "Make white white.", Kind.MOSAIC, Kind.MOSAIC, (AsShot, GrayWorld))
