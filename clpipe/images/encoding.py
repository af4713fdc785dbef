"""How pictures are encoded and tagged: the ``[output]`` table of a configuration."""

from collections.abc import Mapping
from typing import Annotated, Literal

from pydantic import BaseModel, ConfigDict, Field

SIMULATED = "clpipe "  # prefix of the camera's model in a DNG that clpipe writes
Length = Annotated[float, Field(gt=0, le=10000, allow_inf_nan=False)]
Pixels = Annotated[float, Field(gt=0, le=1e7, allow_inf_nan=False)]


class Output(BaseModel):
    """How JPEGs are encoded, and the exposure data for EXIF; None leaves a tag out."""

    model_config = ConfigDict(frozen=True, extra="forbid", strict=True)

    jpeg_quality: Annotated[int, Field(ge=1, le=100)] = 97
    jpeg_subsampling: Literal["4:4:4", "4:2:2", "4:2:0"] = "4:2:2"
    jpeg_progressive: bool = False
    exposure_time: Annotated[float, Field(gt=0, le=86400, allow_inf_nan=False)] | None = None  # s
    focal_length: Length | None = None  # mm
    sensor_width: Length | None = None  # mm, along the longer side of the image
    # Of the render, in px, the first pixel's centre at 0.5; None follows from the lengths in mm
    # and the middle of the image.
    fx: Pixels | None = None
    fy: Pixels | None = None
    cx: float | None = None
    cy: float | None = None

    def filled(self, shot: Mapping[str, float]) -> "Output":
        """A copy in which ``shot``, what a source says of itself, fills the fields that are None.

        >>> Output(focal_length=24.0).filled({"focal_length": 50.0, "exposure_time": 0.5}).shot
        {'exposure_time': 0.5, 'focal_length': 24.0}
        """
        return self.model_copy(update={**shot, **self.shot})

    @property
    def shot(self) -> dict[str, float]:
        """The exposure data that is set, by the names of the fields."""
        return self.model_dump(include=SHOT, exclude_none=True)


SHOT = {"exposure_time", "focal_length", "sensor_width"}
