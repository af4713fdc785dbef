"""Inverse white balance: it comes before the noise, which depends on the sensor's own signal."""

from collections.abc import Mapping
from dataclasses import replace
from typing import ClassVar

import numpy as np

from clpipe.base.types import Floats
from clpipe.reference.cfa import by_site
from clpipe.stage import (
    Argument,
    Context,
    Kind,
    Method,
    Pass,
    ReferenceContext,
    Stage,
    StageRole,
    parameter,
)


class Gains(Method):
    """y / gain: red and blue divided by their white balance gains (green = 1).

    >>> from clpipe.stage import run_reference
    >>> run_reference(Gains(red_gain=2.0, blue_gain=4.0), np.ones((2, 2), np.float32)).tolist()
    [[0.5, 1.0], [1.0, 0.25]]
    """

    method: ClassVar = "gains"
    kernel: ClassVar = "site_gains"
    summary: ClassVar = "divide red and blue by the camera's white balance gains"

    red_gain: float | None = parameter(
        None, "White balance gain of red, green = 1.", auto="from the camera", gt=0, le=64
    )
    blue_gain: float | None = parameter(
        None, "White balance gain of blue, green = 1.", auto="from the camera", gt=0, le=64
    )

    def resolve(self, context: Context) -> "Gains":
        red, blue = context.camera.white_balance_gains
        return self.with_defaults(red_gain=red, blue_gain=blue)

    def next_context(self, context: Context) -> Context:
        assert self.red_gain is not None and self.blue_gain is not None
        return replace(context, gains=(self.red_gain, self.blue_gain))

    def passes(self) -> tuple[Pass, ...]:
        return (Pass("inverse_white_balance", arguments=("pattern", "red", "blue")),)

    def arguments(self, context: Context) -> Mapping[str, Argument]:
        assert self.red_gain is not None and self.blue_gain is not None
        red, blue = np.float32(1 / self.red_gain), np.float32(1 / self.blue_gain)
        return {"pattern": context.cfa, "red": red, "blue": blue}

    def variance(self, before: Floats, signal: Floats, context: Context) -> Floats:
        assert self.red_gain is not None and self.blue_gain is not None
        red, blue = np.float32(self.red_gain**-2), np.float32(self.blue_gain**-2)
        return before * by_site(signal.shape[:2], context.pattern, red, np.float32(1), blue)

    def reference(self, image: Floats, given: ReferenceContext) -> Floats:
        assert self.red_gain is not None and self.blue_gain is not None
        red, blue = np.float32(1 / self.red_gain), np.float32(1 / self.blue_gain)
        return image * by_site(image.shape, given.context.pattern, red, np.float32(1), blue)


STAGE = Stage(
    "inverse_white_balance",
    "Divide by the white balance gains: the render becomes what the sensor sees.",
    Kind.MOSAIC,
    Kind.MOSAIC,
    (Gains,),
    role=StageRole.BALANCE_OF_LIGHT,
)
