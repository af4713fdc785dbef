"""Row noise: an offset that all pixels of a row share, from the readout of that row."""

from typing import ClassVar

from clpipe.base.types import Floats
from clpipe.reference.random import Stream, normal_of_line
from clpipe.reference.resample import Axis
from clpipe.stage import (
    Backend,
    Context,
    GaussianNoise,
    LineTable,
    NoiseScope,
    Numbers,
    Pass,
    Signal,
    StageRole,
    sensor_stage,
)


class LineNoise(GaussianNoise):
    """One Gaussian offset for each row or each column; subclasses choose which, and its scope."""

    kernel: ClassVar = "line_noise"
    axis: ClassVar[Axis]
    scope: ClassVar[NoiseScope]

    def draw(self) -> tuple[Pass, ...]:
        table = LineTable(self.axis)
        return (
            Pass("noise_of_lines", table, ("sigma",), writes="lines", random=self.scope),
            Pass(f"{self.axis[:-1]}_noise", arguments=("lines",)),
        )

    @classmethod
    def apply(cls, y: Signal, n: Numbers, backend: Backend) -> Signal:
        if cls.axis == "rows":
            return y + backend.lines(y.shape[-2])[..., None] * n["sigma"]
        return y + backend.fixed(sensor_columns) * n["sigma"]


def sensor_columns(height: int, width: int, stream: Stream) -> Floats:
    """Return a standard normal for each column, (1, width)."""
    return normal_of_line(width, stream)[None]


class Gaussian(LineNoise):
    """y + sigma * n_r: one Gaussian offset for each row, new in each image.

    n_r is a standard normal of row r; sigma is in signal units.

    >>> import numpy as np
    >>> from clpipe.stage import run_reference
    >>> noisy = run_reference(Gaussian(sigma=0.01), np.zeros((1000, 2), np.float32))
    >>> round(float(noisy.std()), 3), bool((noisy[:, 0] == noisy[:, 1]).all())
    (0.01, True)
    """

    summary: ClassVar = "add a Gaussian offset to each row, new in each image"
    axis: ClassVar = "rows"
    scope: ClassVar = NoiseScope.IMAGE

    def resolve(self, context: Context) -> "Gaussian":
        return self.with_defaults(sigma=context.camera.row_noise(context.iso))


STAGE = sensor_stage(
    "row_noise", "Add an offset to each row.", (Gaussian,), role=StageRole.SENSOR_OFFSETS
)
