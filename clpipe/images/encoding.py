"""The encoding of pictures: the ``[output]`` table of a configuration."""

from datetime import datetime
from typing import Annotated, Literal

from pydantic import BaseModel, ConfigDict, Field, field_validator

DATE = "%Y:%m:%d %H:%M:%S"  # EXIF's format
SIMULATED = "clpipe "  # prefix of the camera's model in a DNG that clpipe writes


class Encoding(BaseModel):
    """How JPEGs and PNGs are encoded."""

    model_config = ConfigDict(frozen=True, extra="forbid", strict=True)

    jpeg_quality: Annotated[int, Field(ge=1, le=100)] = 97
    jpeg_subsampling: Literal["4:4:4", "4:2:2", "4:2:0"] = "4:2:2"
    jpeg_progressive: bool = False
    date: str = ""  # EXIF's DateTimeOriginal
    png_compression: Annotated[int, Field(ge=0, le=9)] = 4  # 6 saves 1.5 % of noise, but is slow

    @field_validator("date")
    @classmethod
    def _check_date(cls, date: str) -> str:
        try:
            return date and f"{datetime.strptime(date, DATE):{DATE}}"
        except ValueError:
            raise ValueError("write the date like 2026:05:04 10:30:00") from None
