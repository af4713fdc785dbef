"""Noise that a whole row shares."""

from collections.abc import Mapping
from typing import ClassVar

import numpy as np

from clpipe.reference.random import normal_of_line
from clpipe.stage import (
    Access,
    Argument,
    Context,
    Frame,
    Kind,
    Method,
    Owner,
    Pass,
    Stage,
    parameter,
)
from clpipe.types import Floats


class Gaussian(Method):
    """One Gaussian offset a row, new in each image.

    >>> from clpipe.stage import alone
    >>> noisy = alone(Gaussian(sigma=0.01), np.zeros((1000, 2), np.float32))
    >>> round(float(noisy.std()), 3), bool((noisy[:, 0] == noisy[:, 1]).all())
    (0.01, True)
    """

    method: ClassVar = "gaussian"
    kernel: ClassVar = "line_noise"
    summary: ClassVar = "add one Gaussian offset a row, new in each image"

    example: ClassVar = {"sigma": 0.01}

    sigma: float | None = parameter(
        None,
        "Standard deviation of the offsets.",
        "signal",
        "from the camera and ISO",
        ge=0,
        le=1,
    )

    def resolve(self, context: Context) -> "Gaussian":
        return self.filled(sigma=context.camera.row_noise(context.iso))

    def passes(self) -> tuple[Pass, ...]:
        if not self.sigma:
            return ()
        return (
            Pass(
                "noise_of_lines",
                Access.LINES,
                arguments=("sigma",),
                writes="lines",
                random=Owner.IMAGE,
                lines="rows",
            ),
            Pass("row_noise", arguments=("lines",)),
        )

    def arguments(self, context: Context) -> Mapping[str, Argument]:
        assert self.sigma is not None
        return {"sigma": np.float32(self.sigma)}

    def reference(self, image: Floats, frame: Frame) -> Floats:
        assert self.sigma is not None
        normals = normal_of_line(image.shape[0], frame.stream[Owner.IMAGE])
        return image + (normals * np.float32(self.sigma))[:, None]


STAGE = Stage(
    "row_noise", "Add noise that a whole row shares.", Kind.MOSAIC, Kind.MOSAIC, (Gaussian,)
)
