"""Crosstalk: light and charge that leak to neighbouring pixels."""

from typing import ClassVar

from clpipe.stage import (
    Backend,
    Context,
    Numbers,
    Pass,
    Signal,
    SignalMethod,
    Stencil,
    camera_parameter,
    sensor_stage,
)


class Neighbours(SignalMethod):
    """y + share * (the four neighbours - 4 y): each pixel gives a share of its charge to each side.

    The neighbours have other colours, so colours become less saturated and edges softer. The stage
    comes before shot noise, which stays independent (Holst and Lomheim, CMOS/CCD Sensors and Camera
    Systems, 2nd ed. 2011).

    >>> import numpy as np
    >>> from clpipe.stage import run_reference
    >>> dot = np.zeros((5, 5), np.float32)
    >>> dot[2, 2] = 1
    >>> run_reference(Neighbours(share=0.05), dot)[2, 1:4].astype(float).round(2).tolist()
    [0.05, 0.8, 0.05]
    """

    method: ClassVar = "neighbours"
    kernel: ClassVar = "crosstalk"
    summary: ClassVar = "give a share of each pixel's charge to its four neighbours"
    example: ClassVar = {"share": 0.02}

    share: float | None = camera_parameter(
        "Share of a pixel's charge that leaks to each of its four neighbours.", ge=0, le=0.2
    )

    def resolve(self, context: Context) -> "Neighbours":
        return self.with_defaults(share=context.camera.crosstalk)

    def passes(self) -> tuple[Pass, ...]:
        return (Pass("crosstalk", Stencil(1), ("share",)),) if self.share else ()

    @classmethod
    def apply(cls, y: Signal, n: Numbers, backend: Backend) -> Signal:
        across = backend.tap(y, -1, 0) + backend.tap(y, 1, 0)
        down = backend.tap(y, 0, -1) + backend.tap(y, 0, 1)
        return y + ((across + down) - y * 4) * n["share"]


STAGE = sensor_stage("crosstalk", "Let charge leak to neighbouring pixels.", (Neighbours,))
