"""Column noise: an offset that all pixels of a column share, from its readout circuit."""

from typing import ClassVar

from clpipe.stage import Context, NoiseScope, StageRole, sensor_stage
from clpipe.stages.row_noise import LineNoise


class Gaussian(LineNoise):
    """y + sigma * n_x: one Gaussian offset per column, the same in every image of a camera.

    n_x is a standard normal of column x; sigma is in signal units.

    >>> import numpy as np
    >>> from clpipe.stage import run_reference
    >>> noisy = run_reference(Gaussian(sigma=0.01), np.zeros((2, 1000), np.float32))
    >>> round(float(noisy.std()), 3), bool((noisy[0] == noisy[1]).all())
    (0.01, True)
    """

    summary: ClassVar = "add a Gaussian offset to each column, the same in every image of a camera"
    axis: ClassVar = "columns"
    scope: ClassVar = NoiseScope.CAMERA

    def resolve(self, context: Context) -> "Gaussian":
        return self.with_defaults(sigma=context.camera.column_noise(context.iso))


STAGE = sensor_stage(
    "column_noise", "Add an offset to each column.", (Gaussian,), role=StageRole.SENSOR_OFFSETS
)
