"""Levels: from DN to signal, the first step of a raw converter."""

from typing import ClassVar

import numpy as np
from pydantic import model_validator

from clpipe.base.types import Floats
from clpipe.stage import (
    Arguments,
    Context,
    Kind,
    Method,
    Pass,
    ReferenceContext,
    Stage,
    StageRole,
    parameter,
)


class Linear(Method):
    """(DN - black) / (white - black); values below black stay negative.

    >>> from clpipe.stage import run_reference
    >>> linear = Linear(black_level=100, white_level=1124)
    >>> run_reference(linear, np.float32([[36, 100, 612]])).tolist()
    [[-0.0625, 0.0, 0.5]]
    """

    method: ClassVar = "linear"
    kernel: ClassVar = "normalize"
    summary: ClassVar = "subtract the black level and scale the white level to 1"

    black_level: float | None = parameter(
        None,
        "DN that becomes 0.",
        "DN",
        "as quantize used it, else from the camera",
        ge=0,
        le=65535,
    )
    white_level: float | None = parameter(
        None,
        "DN that becomes 1.",
        "DN",
        "as quantize used it, else from the camera",
        gt=0,
        le=65535,
    )

    @model_validator(mode="after")
    def _ordered(self) -> "Linear":
        black, white = self.black_level, self.white_level
        if black is not None and white is not None and white <= black:
            raise ValueError(
                f"white_level must be above black_level; "
                f"found {self.white_level} and {self.black_level}"
            )
        return self

    def resolve(self, context: Context) -> "Linear":
        camera = context.camera
        black = camera.black_level if context.black_level is None else context.black_level
        white = camera.white_level if context.white_level is None else context.white_level
        filled = self.with_defaults(black_level=black, white_level=white)
        return type(self).model_validate(filled.model_dump())

    def passes(self) -> tuple[Pass, ...]:
        return (Pass("normalize_levels", arguments=("black_level", "scale")),)

    def arguments(self, context: Context) -> Arguments:
        assert self.black_level is not None and self.white_level is not None
        scale = np.float32(1 / (self.white_level - self.black_level))
        return {"black_level": np.float32(self.black_level), "scale": scale}

    def variance(self, before: Floats, signal: Floats, context: Context) -> Floats:
        assert self.black_level is not None and self.white_level is not None
        return before * np.float32((self.white_level - self.black_level) ** -2)

    def reference(self, image: Floats, given: ReferenceContext) -> Floats:
        assert self.black_level is not None and self.white_level is not None
        scale = np.float32(1 / (self.white_level - self.black_level))
        return (image - np.float32(self.black_level)) * scale


STAGE = Stage(
    "normalize",
    "Apply the levels: DN to signal.",
    Kind.RAW,
    Kind.MOSAIC,
    (Linear,),
    role=StageRole.LEVELS,
)
