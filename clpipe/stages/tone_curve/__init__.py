"""Tone curve: the contrast of a photograph, on linear RGB, before gamma."""

from importlib import resources
from typing import ClassVar, Self

import numpy as np
from pydantic import field_validator

from clpipe.base.types import Floats
from clpipe.stage import Arguments as Arguments
from clpipe.stage import (
    Context,
    Curve,
    Method,
    Pass,
    ReferenceContext,
    StageRole,
    parameter,
    rgb_stage,
)
from clpipe.stages.tone_curve.neutral import Neutral
from clpipe.stages.tone_curve.standard import Standard
from clpipe.stages.tone_curve.table import load_table

CAMERA_RAW = str(resources.files("clpipe.stages.tone_curve") / "camera_raw.csv")


class CameraRaw(Curve):
    """The default curve of Adobe Camera Raw, on each channel of linear RGB, 0..1.

    The knots are from the DNG SDK (reference [15] of Bielova et al. 2019), with a monotone cubic
    between them. Applied to each channel, the curve changes hues: orange becomes yellow.
    """

    method: ClassVar = "camera_raw"
    summary: ClassVar = "the default curve of Adobe Camera Raw (DNG SDK), on each channel"

    def table(self) -> Floats:
        return load_table(CAMERA_RAW)


class Linear(Method):
    """No curve: keeps the render's sRGB look. The headroom is given back."""

    method: ClassVar = "linear"
    kernel: ClassVar = "exposure"
    summary: ClassVar = "no curve: keeps the render's sRGB look"
    example: ClassVar = {"headroom": 1.0}

    headroom: float | None = parameter(
        None, "Stops by which the image is brightened.", "EV", "from exposure", ge=0, le=100
    )

    def resolve(self, context: Context) -> Self:
        return self.with_defaults(headroom=context.headroom)

    @property
    def gain(self) -> float:
        """The gain."""
        assert self.headroom is not None
        return 2.0**self.headroom

    def passes(self) -> tuple[Pass, ...]:
        return (Pass("exposure", arguments=("gain",)),) if self.headroom else ()

    def reference(self, image: Floats, inputs: ReferenceContext) -> Floats:
        return image * np.float32(self.gain)


class File(Curve):
    """A curve from a file, on each channel of linear RGB, 0..1."""

    method: ClassVar = "file"
    summary: ClassVar = "a curve from a .csv (x,y; monotone cubic) or one-dimensional .cube file"

    read: ClassVar = staticmethod(load_table)

    path: str = parameter(
        CAMERA_RAW,
        "File of the curve; in a configuration, the path is relative to that file.",
        auto="camera_raw.csv",
        file=True,
    )

    @field_validator("path")
    @classmethod
    def _check_file(cls, path: str) -> str:
        cls.read(path)
        return path

    def table(self) -> Floats:
        return self.read(self.path)


STAGE = rgb_stage(
    "tone_curve",
    "Apply a tone curve with the contrast of a photograph.",
    (Standard, Neutral, CameraRaw, Linear, File),
    role=StageRole.RESPONSE,
)
