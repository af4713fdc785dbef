"""Tags: what goes into a picture's EXIF, and how an image carries it from stage to stage."""

import json
import math
import re
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from functools import cache

import numpy as np
from pydantic import TypeAdapter

from clpipe.base.errors import ImageError
from clpipe.base.types import Array
from clpipe.camera.gain_stage import Positive
from clpipe.camera.optics import FILM_DIAGONAL
from clpipe.images.encoding import Encoding

TAG_ATTRIBUTES = ("exif", "orientation")  # the attributes by which an image carries its tags
DATE = re.compile(r"\d{4}:\d\d:\d\d \d\d:\d\d:\d\d")  # as EXIF has it
NOT_CARRIED = ("sensor_width", "encoding")  # the fields of tags that no image carries
DAMAGED = "its attributes clpipe:exif and clpipe:orientation are damaged"


@dataclass(frozen=True)
class Tags:
    """What goes into a picture's EXIF, and how the picture is encoded; None is unknown."""

    make: str
    model: str
    iso: Positive
    exposure: Positive | None = None  # s
    aperture: Positive | None = None  # f-number
    bias: float | None = None  # EV over the render as it is
    focal_length: Positive | None = None  # mm
    lens: str = ""  # its model
    focus_distance: Positive | None = None  # m
    taken: str = ""  # "YYYY:MM:DD HH:MM:SS"
    sensor_width: Positive | None = None  # mm, along the longer side
    encoding: Encoding = field(default_factory=Encoding)

    @property
    def shot(self) -> dict[str, float]:
        """Exposure time and focal length where known, by the names that a render's camera has."""
        values = {"exposure_time": self.exposure, "focal_length": self.focal_length}
        return {name: value for name, value in values.items() if value}


def exif(tags: Tags, height: int, width: int) -> dict[str, float | str]:
    """EXIF tags (EXIF 2.3, 2010) by their names.

    The equivalent focal length is by the ratio of diagonals (CIPA DCG-001, 2018), as
    structure-from-motion tools take it; EXIF holds whole mm.

    Args:
        tags: what is known; EXIF holds an ISO of at most 65535.
        height: of the image, px.
        width: of the image, px.

    >>> tags = Tags("", "", 800, focal_length=24.0, sensor_width=24.0)
    >>> for name, value in exif(tags, 4000, 6000).items():
    ...     print(name, value)
    PhotographicSensitivity 800
    FocalLength 24.0
    FocalLengthIn35mmFilm 36
    FocalPlaneXResolution 2500.0
    FocalPlaneYResolution 2500.0
    FocalPlaneResolutionUnit 3
    """
    values: dict[str, float | str] = {"PhotographicSensitivity": min(round(tags.iso), 65535)}
    if tags.exposure:
        values["ExposureTime"] = tags.exposure
    if tags.aperture:
        values["FNumber"] = tags.aperture
    if tags.bias is not None:
        values["ExposureBiasValue"] = tags.bias
    if tags.lens:
        values["LensModel"] = tags.lens
    if tags.focus_distance:
        values["SubjectDistance"] = tags.focus_distance
    if tags.taken:
        values["DateTimeOriginal"] = tags.taken
    if tags.focal_length:
        values["FocalLength"] = tags.focal_length
    if tags.sensor_width:
        per_mm = max(height, width) / tags.sensor_width
        if tags.focal_length:
            diagonal = math.hypot(height, width) / per_mm
            equivalent = round(tags.focal_length * FILM_DIAGONAL / diagonal)
            values["FocalLengthIn35mmFilm"] = min(max(equivalent, 1), 65535)
        values |= {"FocalPlaneXResolution": per_mm * 10, "FocalPlaneYResolution": per_mm * 10}
        values["FocalPlaneResolutionUnit"] = 3  # cm
    return values


def to_attributes(tags: Tags, orientation: int) -> dict[str, str]:
    """The attributes by which an image carries its tags and its orientation (EXIF's, 1 to 8)."""
    values = {name: value for name, value in asdict(tags).items() if name not in NOT_CARRIED}
    return shot_to_attributes(values, orientation)


def shot_to_attributes(shot: Mapping[str, float | str], orientation: int) -> dict[str, str]:
    """As :func:`to_attributes`, of those fields of :class:`Tags` that the image says itself."""
    return {"exif": json.dumps(shot), "orientation": str(orientation)}


def exposed_attributes(attributes: Mapping[str, str], tags: Tags) -> dict[str, str]:
    """The attribute of an image's tags with the exposure that it was given since."""
    said = {"exposure": tags.exposure, "bias": tags.bias}
    return {"exif": json.dumps({**json.loads(attributes.get("exif", "{}")), **said})}


def from_attributes(attributes: Mapping[str, str], default: Tags) -> tuple[Tags, int]:
    """The tags and the orientation that an image carries.

    What it does not say is that of ``default``, and upright.

    Raises:
        ImageError: the attributes are damaged.
    """
    try:
        own = json.loads(attributes.get("exif", "{}"))
        tags = _adapter().validate_python({**vars(default), **own})
    except (ValueError, TypeError):
        raise ImageError(DAMAGED) from None
    return tags, orientation_of(attributes)


@cache
def _adapter() -> TypeAdapter[Tags]:
    return TypeAdapter(Tags)  # which takes a millisecond to make


def sensor_width(focal_length: float, equivalent: float, height: int, width: int) -> float:
    """The longer side of a sensor, in mm, from a focal length and what it is on 35 mm film.

    The equivalent is by the ratio of diagonals, as in :func:`exif`.

    >>> round(sensor_width(24.0, 36.0, 4000, 6000), 1)
    24.0
    """
    diagonal = FILM_DIAGONAL * focal_length / equivalent
    return diagonal * max(height, width) / math.hypot(height, width)


def orientation_of(attributes: Mapping[str, str]) -> int:
    """The orientation that an image carries (EXIF's, 1 to 8), else 1 (upright).

    Raises:
        ImageError: the attribute is damaged.
    """
    orientation = attributes.get("orientation", "1")
    if orientation not in map(str, FLIPS):
        raise ImageError(DAMAGED)
    return int(orientation)


# By EXIF's orientation: whether to flip left to right, whether to flip upside down, and whether
# then to transpose.
FLIPS = {
    1: (False, False, False),
    2: (True, False, False),
    3: (True, True, False),
    4: (False, True, False),
    5: (False, False, True),
    6: (False, True, True),
    7: (True, True, True),
    8: (True, False, True),
}


def upright(image: Array, orientation: int) -> Array:
    """An image, (height, width[, channel]), turned upright by EXIF's orientation, 1 to 8.

    >>> upright(np.array([[1, 2], [3, 4]]), 6).tolist()  # its right side is now at the bottom
    [[3, 1], [4, 2]]
    """
    mirrored, upside_down, transposed = FLIPS[orientation]
    image = image[:, ::-1] if mirrored else image
    image = image[::-1] if upside_down else image
    return np.ascontiguousarray(image.swapaxes(0, 1) if transposed else image)
