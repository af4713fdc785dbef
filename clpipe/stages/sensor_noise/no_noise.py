"""An ideal sensor: no noise, but a full well."""

from typing import ClassVar

from clpipe.base.types import Floats
from clpipe.stage import Backend, Context, Numbers, Pass, Signal, SignalMethod, camera_parameter

NEVER_FULL = 1e30  # full well in electrons or signal units, for sensors that never saturate


def or_default(value: float | None, default: float) -> float:
    """Return the value, or the default for None."""
    return default if value is None else value


class NoNoise(SignalMethod):
    """No noise: min(y, full_signal), since an ideal sensor still has a full well.

    >>> import numpy as np
    >>> from clpipe.stage import run_reference
    >>> run_reference(NoNoise(full_signal=0.5), np.float32([[0.25, 0.75]])).tolist()
    [[0.25, 0.5]]
    """

    method: ClassVar = "none"
    kernel: ClassVar = "full_well"
    summary: ClassVar = "no noise; the full well still clips"
    example: ClassVar = {"full_signal": 0.5}

    full_signal: float | None = camera_parameter(
        "Signal at which the well is full.", "signal", more=" and ISO; else no limit", gt=0
    )

    def resolve(self, context: Context) -> "NoNoise":
        camera = context.camera
        full = camera.signal_of(camera.full_well, context.iso) if camera.full_well else None
        return self.with_defaults(full_signal=full)

    def passes(self) -> tuple[Pass, ...]:
        return (Pass("full_well", arguments=("full_signal",)),) if self.full_signal else ()

    def variance(self, input_variance: Floats, signal: Floats, context: Context) -> Floats:
        return input_variance

    @classmethod
    def apply(cls, y: Signal, n: Numbers, backend: Backend) -> Signal:
        return backend.minimum(y, n["full_signal"])
