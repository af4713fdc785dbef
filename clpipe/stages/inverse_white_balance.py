"""Inverse white balance, before the noise, which depends on the sensor's own signal."""

from typing import ClassVar

import numpy as np

from clpipe.base.types import Floats
from clpipe.reference.cfa import by_site
from clpipe.stage import Arguments, Context, Kind, Pass, ReferenceContext, Stage, StageRole
from clpipe.stages.white_balance.gains import ArrayMethod, CameraGains


class Gains(CameraGains):
    """y / gain: red and blue divided by their white balance gains (green = 1).

    >>> from clpipe.stage import run_reference
    >>> run_reference(Gains(red_gain=2.0, blue_gain=4.0), np.ones((2, 2), np.float32)).tolist()
    [[0.5, 1.0], [1.0, 0.25]]
    """

    method: ClassVar = "gains"
    kernel: ClassVar = "site_gains"
    summary: ClassVar = "divide red and blue by the camera's white balance gains"
    any_array: ClassVar = True

    @property
    def factors(self) -> tuple[float, float]:
        """The factors of red and blue."""
        red, blue = self.gains
        return 1 / red, 1 / blue

    def resolve(self, context: Context) -> CameraGains:
        red, blue = context.illuminant_gains
        resolved = self.with_defaults(red_gain=red, blue_gain=blue)
        return ArrayGains.for_array(context.array, resolved) if context.array else resolved

    def next_context(self, context: Context) -> Context:
        return context.replace(gains=self.gains)

    def passes(self) -> tuple[Pass, ...]:
        return (Pass("inverse_white_balance", arguments=("pattern", "red", "blue")),)

    def arguments(self, context: Context) -> Arguments:
        red, blue = self.factors
        return {"pattern": context.cfa, "red": red, "blue": blue}

    def variance(self, input_variance: Floats, signal: Floats, context: Context) -> Floats:
        red, blue = (np.float32(gain**-2) for gain in self.gains)
        return input_variance * by_site(signal.shape[:2], context.pattern, red, np.float32(1), blue)

    def reference(self, image: Floats, inputs: ReferenceContext) -> Floats:
        red, blue = map(np.float32, self.factors)
        return image * by_site(image.shape, inputs.context.pattern, red, np.float32(1), blue)


class ArrayGains(ArrayMethod, Gains):
    """Division by the gains on any filter array: white fills the most sensitive channel."""

    function: ClassVar = "white_to_level"
    inverse: ClassVar = False

    def variance(self, input_variance: Floats, signal: Floats, context: Context) -> Floats:
        return input_variance * self.factors_at(signal.shape[:2]) ** 2

    def reference(self, image: Floats, inputs: ReferenceContext) -> Floats:
        return image * self.factors_at(image.shape)


STAGE = Stage(
    "inverse_white_balance",
    "Divide by the white balance gains, so that a render becomes what the sensor sees.",
    Kind.MOSAIC,
    Kind.MOSAIC,
    (Gains,),
    role=StageRole.BALANCE_OF_LIGHT,
)
