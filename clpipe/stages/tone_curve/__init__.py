"""Tone curve: the contrast of a photograph, on linear RGB, before gamma."""

from importlib import resources
from typing import ClassVar

from pydantic import field_validator

from clpipe.base.types import Floats
from clpipe.stage import Curve, Kind, Stage, Unchanged, parameter
from clpipe.stages.tone_curve.table import table_of

DEFAULT = str(resources.files("clpipe.stages.tone_curve") / "default.csv")


class Default(Curve):
    """The default curve of Adobe Camera Raw, on each channel of linear RGB, 0..1.

    The knots are from the DNG SDK (reference [15] of Bielova et al. 2019), with a monotone cubic
    between them.
    """

    method: ClassVar = "default"
    summary: ClassVar = "the default curve of Adobe Camera Raw (DNG SDK)"

    def table(self) -> Floats:
        return table_of(DEFAULT)


class Linear(Unchanged):
    """No curve: the contrast of the scene."""

    method: ClassVar = "linear"
    summary: ClassVar = "no curve"


class File(Curve):
    """A curve from a file, on each channel of linear RGB, 0..1."""

    method: ClassVar = "file"
    summary: ClassVar = "a curve from a .csv (x,y; monotone cubic) or one-dimensional .cube file"

    path: str = parameter(
        DEFAULT,
        "The file of the curve; a configuration gives it relative to itself.",
        auto="default.csv",
        file=True,
    )

    @field_validator("path")
    @classmethod
    def _readable(cls, path: str) -> str:
        table_of(path)
        return path

    def table(self) -> Floats:
        return table_of(self.path)


STAGE = Stage(
    "tone_curve",
    "Give the image the contrast of a photograph.",
    Kind.RGB,
    Kind.RGB,
    (Default, Linear, File),
)
