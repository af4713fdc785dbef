"""Exposure compensation."""

from collections.abc import Mapping
from typing import ClassVar

import numpy as np

from clpipe.base.types import Floats
from clpipe.stage import Argument, Context, Frame, Kind, Method, Pass, Stage, parameter


class Gain(Method):
    """Linear light times 2^ev.

    >>> from clpipe.stage import run_reference
    >>> run_reference(Gain(ev=-1.0), np.float32([[[0.5, 1, 4]]])).tolist()
    [[[0.25, 0.5, 2.0]]]
    """

    method: ClassVar = "gain"
    kernel: ClassVar = "exposure"
    summary: ClassVar = "multiply linear light by 2^ev"
    example: ClassVar = {"ev": 0.7}

    ev: float = parameter(0.0, "Exposure compensation; +1 doubles the light.", "EV", ge=-20, le=20)

    def passes(self) -> tuple[Pass, ...]:
        return (Pass("exposure", arguments=("gain",)),)

    def arguments(self, context: Context) -> Mapping[str, Argument]:
        return {"gain": np.float32(2.0**self.ev)}

    def reference(self, image: Floats, frame: Frame) -> Floats:
        return image * np.float32(2.0**self.ev)


STAGE = Stage("exposure", "Brighten or darken the scene.", Kind.RGB, Kind.RGB, (Gain,))
