"""Exposure by a number of stops."""

from typing import ClassVar

import numpy as np

from clpipe.base.types import Floats
from clpipe.stage import Arguments, Context, Method, Pass, ReferenceContext, parameter


class Exposing(Method):
    """Base of the methods that scale linear light to a level of the sensor."""

    kernel: ClassVar = "exposure"
    overscan: ClassVar = True

    ev: float = parameter(0.0, "Exposure compensation; +1 doubles the light.", "EV", ge=-20, le=20)
    headroom: float = parameter(
        1.0,
        "Range for highlights between a render's 1.0 and the sensor's white. The tone curves "
        "standard and neutral restore one stop of brightness, and linear restores all of it.",
        "EV",
        ge=0,
        le=10,
    )

    def next_context(self, context: Context) -> Context:
        time = self.time(context.exposure_time)
        return context.replace(headroom=context.headroom + self.headroom, exposure_time=time)

    def time(self, exposure_time: float | None) -> float | None:
        """The exposure time, s: EVs change it, like in a camera's bracket."""
        return exposure_time and exposure_time * 2.0**self.ev

    def gain_at(self, iso: float) -> float:
        """The value of a render's 1.0 over the sensor's full scale, without gain from metering."""
        return float(np.float32(self.factor(iso)))

    @property
    def gain(self) -> float:
        """The gain."""
        return 2.0 ** (self.ev - self.headroom)

    def factor(self, iso: float) -> float:
        """Return the value of one unit of a render, over the sensor's full scale, at an ISO."""
        return self.gain

    def passes(self) -> tuple[Pass, ...]:
        return (Pass("exposure", arguments=("gain",)),)

    def arguments(self, context: Context) -> Arguments:
        return {"gain": self.factor(context.iso)}

    def reference(self, image: Floats, inputs: ReferenceContext) -> Floats:
        return image * np.float32(self.factor(inputs.context.iso))


class Gain(Exposing):
    """Linear light times 2^(ev - headroom).

    A camera's exposure puts a white surface well below saturation, and its tone curve restores the
    brightness. Highlights above 1.0 then roll off instead of clipping.

    >>> from clpipe.stage import run_reference
    >>> run_reference(Gain(ev=-1.0), np.float32([[[0.5, 1, 4]]])).tolist()
    [[[0.125, 0.25, 1.0]]]
    """

    method: ClassVar = "gain"
    summary: ClassVar = "multiply linear light by 2^(ev - headroom)"
    example: ClassVar = {"ev": 0.7}

    sets_time: bool = parameter(
        True,
        "Whether ev changes the exposure time as well. If not, the stated time is already that of "
        "the picture, such as the one that auto exposure sets.",
    )

    def time(self, exposure_time: float | None) -> float | None:
        """The exposure time, s, which EVs change, unless it is already that of the picture."""
        return super().time(exposure_time) if self.sets_time else exposure_time
