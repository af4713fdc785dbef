"""Restored highlights: for a photograph, before its white balance is undone."""

from typing import ClassVar

import numpy as np

from clpipe.base.types import Floats
from clpipe.stage import Context, Pass, ReferenceContext, rgb_stage
from clpipe.stages.white_balance.gains import CameraGains, gain_parameter


class Brooks2019(CameraGains):
    """Red and blue of nearly white pixels, raised so that dividing by the gains leaves them white.

    Where a photograph is white, all three colours of the sensor are clipped, and dividing red and
    blue by their gains would tint it. Each colour is therefore multiplied by ``max(m*gain + 1 - m,
    1)``, with ``m = (max(grey - 0.9, 0) / 0.1)^2``, at most 1. In it, grey is the mean of the
    colours. ``inverse_white_balance`` divides later. The method comes from Brooks et al.,
    "Unprocessing images for learned raw denoising", CVPR 2019, sec. 3.3.

    >>> from clpipe.stage import run_reference
    >>> image = np.float32([[[1, 1, 1], [0.5, 0.5, 0.5]]])
    >>> run_reference(Brooks2019(red_gain=2.0, blue_gain=1.5), image).tolist()
    [[[2.0, 1.0, 1.5], [0.5, 0.5, 0.5]]]
    """

    method: ClassVar = "brooks2019"
    kernel: ClassVar = "restore_highlights"
    summary: ClassVar = "raise red and blue of nearly white pixels by the gains"

    red_gain: float | None = gain_parameter("red", auto="the gain of inverse_white_balance")
    blue_gain: float | None = gain_parameter("blue", auto="the gain of inverse_white_balance")

    def resolve(self, context: Context) -> CameraGains:
        red, blue = context.illuminant_gains
        return self.with_defaults(red_gain=red, blue_gain=blue)

    def passes(self) -> tuple[Pass, ...]:
        return (Pass("restore_highlights", arguments=("red_gain", "blue_gain")),)

    def reference(self, image: Floats, inputs: ReferenceContext) -> Floats:
        one = np.float32(1)
        red, green, blue = np.moveaxis(image, -1, 0)
        grey = ((red + green) + blue) * np.float32(1 / 3)
        m = np.maximum(grey - np.float32(0.9), np.float32(0)) * np.float32(10)
        m = np.minimum(m * m, one)
        raised = [
            colour * np.maximum(m * np.float32(gain) + (one - m), one)
            for colour, gain in ((red, self.red_gain), (blue, self.blue_gain))
        ]
        return np.stack([raised[0], green, raised[1]], axis=-1)


STAGE = rgb_stage(
    "restore_highlights",
    "Restore red and blue in the clipped highlights of a photograph.",
    (Brooks2019,),
)
