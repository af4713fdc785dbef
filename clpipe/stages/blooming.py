"""Blooming: charge that a full pixel cannot hold flows to its neighbours in the column."""

from typing import ClassVar

from clpipe.stage import (
    Arguments,
    Backend,
    Context,
    Numbers,
    Pass,
    Signal,
    SignalMethod,
    Stencil,
    Unchanged,
    camera_parameter,
    parameter,
    sensor_stage,
)

RADIUS = 16  # px


class NoBlooming(Unchanged):
    """No blooming, for sensors that drain excess charge."""

    summary: ClassVar = "no blooming, for sensors that drain excess charge"


class Column(SignalMethod):
    """Charge above the full well flows along the column, half of it up and half down.

    The pixel at distance k receives the share (1 - spill) * spill^(k - 1) of each half, up to 16
    px. It holds no more than its own full well. Bright lamps get streaks in this way.

    >>> import numpy as np
    >>> from clpipe.stage import run_reference
    >>> lamp = np.zeros((65, 1), np.float32)
    >>> lamp[32] = 3
    >>> run_reference(Column(full_signal=1.0, spill=0.5), lamp)[30:35, 0].tolist()
    [0.25, 0.5, 1.0, 0.5, 0.25]
    """

    method: ClassVar = "column"
    kernel: ClassVar = "blooming"
    summary: ClassVar = "charge above the full well flows along the column"
    example: ClassVar = {"full_signal": 0.4, "spill": 0.7}

    full_signal: float | None = camera_parameter(
        "Signal of a full pixel.", "signal", more=" and ISO; else 1", gt=0, le=1e6
    )
    spill: float = parameter(
        0.7, "Share of the excess charge that each pixel passes on to the next one.", ge=0, lt=1
    )

    def resolve(self, context: Context) -> "Column":
        full = context.camera.full_well
        return self.with_defaults(
            full_signal=context.camera.signal_of(full, context.iso) if full else 1.0
        )

    def passes(self) -> tuple[Pass, ...]:
        return (Pass("blooming", Stencil(RADIUS), ("full", "first", "spill")),)

    def arguments(self, context: Context) -> Arguments:
        first = (1 - self.spill) / 2
        return {"full": self.full_signal, "first": first, "spill": self.spill}

    @classmethod
    def apply(cls, y: Signal, n: Numbers, backend: Backend) -> Signal:
        full, weight = n["full"], n["first"]
        excess = (y - full).clip(min=0)
        received = 0.0
        for k in range(1, RADIUS + 1):
            received = received + (backend.tap(excess, 0, -k) + backend.tap(excess, 0, k)) * weight
            weight = weight * n["spill"]
        return backend.minimum(backend.minimum(y, full) + received, full)


STAGE = sensor_stage("blooming", "Let charge overflow from full pixels.", (NoBlooming, Column))
