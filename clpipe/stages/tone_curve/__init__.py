"""The tone curve."""

from importlib import resources
from typing import ClassVar

from pydantic import field_validator

from clpipe.base.types import Floats
from clpipe.stage import Curve, Kind, Stage, Unchanged, parameter
from clpipe.stages.tone_curve.table import table_of

DEFAULT = str(resources.files("clpipe.stages.tone_curve") / "default.csv")


class Default(Curve):
    """The default curve of Adobe Camera Raw, on each channel of linear RGB, 0..1.

    Its knots are those of the DNG SDK (the paper's reference [15]), a monotone cubic between them.
    """

    method: ClassVar = "default"
    summary: ClassVar = "the default curve of Adobe Camera Raw (DNG SDK)"

    def table(self) -> Floats:
        return table_of(DEFAULT)


class Linear(Unchanged):
    """No curve: contrast as in the scene."""

    method: ClassVar = "linear"
    summary: ClassVar = "no curve"


class File(Curve):
    """A curve of one's own on each channel of linear RGB, 0..1."""

    method: ClassVar = "file"
    summary: ClassVar = "a curve from a .csv (x,y; monotone cubic) or one-dimensional .cube file"

    path: str = parameter(
        DEFAULT, "The file; in a configuration, relative to it.", auto="default.csv", file=True
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
    "Contrast, as a photograph has it.",
    Kind.RGB,
    Kind.RGB,
    (Default, Linear, File),
)
