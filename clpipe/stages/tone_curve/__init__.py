"""The tone curve."""

from collections.abc import Mapping
from importlib import resources
from typing import ClassVar

from pydantic import field_validator

from clpipe.reference.curve import curve_index
from clpipe.stage import Access, Argument, Context, Frame, Kind, Method, Pass, Stage, parameter
from clpipe.stages.tone_curve.table import table_of
from clpipe.types import Floats

DEFAULT = str(resources.files("clpipe") / "curves" / "default.csv")


class Default(Method):
    """The default curve of Adobe Camera Raw, on each channel of linear RGB, 0..1.

    Its knots are those of the DNG SDK (the paper's reference [15]), a monotone cubic between them.
    """

    method: ClassVar = "default"
    kernel: ClassVar = "curve"
    summary: ClassVar = "the default curve of Adobe Camera Raw (DNG SDK)"

    def passes(self) -> tuple[Pass, ...]:
        return (Pass("curve", Access.CURVE, ("table",)),)

    def arguments(self, context: Context) -> Mapping[str, Argument]:
        return {"table": table_of(DEFAULT)}

    def reference(self, image: Floats, frame: Frame) -> Floats:
        return table_of(DEFAULT)[curve_index(image)]


class Linear(Method):
    """No curve: contrast as in the scene."""

    method: ClassVar = "linear"
    kernel: ClassVar = ""
    summary: ClassVar = "no curve"

    def passes(self) -> tuple[Pass, ...]:
        return ()

    def reference(self, image: Floats, frame: Frame) -> Floats:
        return image


class File(Method):
    """A curve of one's own on each channel of linear RGB, 0..1."""

    method: ClassVar = "file"
    kernel: ClassVar = "curve"
    summary: ClassVar = "a curve from a .csv (x,y; monotone cubic) or one-dimensional .cube file"

    path: str = parameter(
        DEFAULT, "The file; in a configuration, relative to it.", auto="default.csv", file=True
    )

    @field_validator("path")
    @classmethod
    def _readable(cls, path: str) -> str:
        table_of(path)
        return path

    def passes(self) -> tuple[Pass, ...]:
        return (Pass("curve", Access.CURVE, ("table",)),)

    def arguments(self, context: Context) -> Mapping[str, Argument]:
        return {"table": table_of(self.path)}

    def reference(self, image: Floats, frame: Frame) -> Floats:
        return table_of(self.path)[curve_index(image)]


STAGE = Stage(
    "tone_curve",
    "Contrast, as a photograph has it.",
    Kind.RGB,
    Kind.RGB,
    (Default, Linear, File),
)
