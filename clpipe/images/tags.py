"""Tags: the values in a picture's EXIF, and the attributes that store them in kept images."""

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

TAG_ATTRIBUTES = ("exif", "orientation")  # attributes that contain an image's tags
DATE_PATTERN = re.compile(r"\d{4}:\d\d:\d\d \d\d:\d\d:\d\d")  # EXIF's format
NOT_CARRIED = ("sensor_width", "encoding")  # fields of tags that attributes do not contain
DAMAGED = "its attributes clpipe:exif and clpipe:orientation are damaged; write the file again"


@dataclass(frozen=True)
class Tags:
    """The values for a picture's EXIF, and the picture's encoding; None is unknown."""

    make: str
    model: str
    iso: Positive
    exposure: Positive | None = None  # s
    aperture: Positive | None = None  # f-number
    bias: float | None = None  # EV relative to the render
    focal_length: Positive | None = None  # mm
    lens: str = ""  # model of the lens
    focus_distance: Positive | None = None  # m
    taken: str = ""  # "YYYY:MM:DD HH:MM:SS"
    sensor_width: Positive | None = None  # mm, along the longer side
    encoding: Encoding = field(default_factory=Encoding)

    @property
    def shot(self) -> dict[str, float]:
        """Exposure time and focal length, if known, by the names of a render's camera."""
        values = {"exposure_time": self.exposure, "focal_length": self.focal_length}
        return {name: value for name, value in values.items() if value}


def exif(tags: Tags, height: int, width: int) -> dict[str, float | str]:
    """Return EXIF tags (EXIF 2.3, 2010) by name.

    The equivalent focal length follows from the ratio of diagonals (CIPA DCG-001, 2018), which is
    also what structure-from-motion tools expect. EXIF stores it in whole mm.

    Args:
        tags: the known values; EXIF limits the ISO to 65535.
        height: height of the image in px.
        width: width of the image in px.

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
    stated = {
        "PhotographicSensitivity": min(round(tags.iso), 65535),
        "ExposureTime": tags.exposure,
        "FNumber": tags.aperture,
        "ExposureBiasValue": tags.bias,
        "LensModel": tags.lens or None,
        "SubjectDistance": tags.focus_distance,
        "DateTimeOriginal": tags.taken or None,
        "FocalLength": tags.focal_length,
    }
    values = {name: value for name, value in stated.items() if value is not None}
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
    """Return the attributes that contain an image's tags and orientation (EXIF's, 1 to 8)."""
    values = {name: value for name, value in asdict(tags).items() if name not in NOT_CARRIED}
    return shot_to_attributes(values, orientation)


def shot_to_attributes(shot: Mapping[str, float | str], orientation: int) -> dict[str, str]:
    """Return the attributes for the fields of :class:`Tags` that an image states itself."""
    return {"exif": json.dumps(shot), "orientation": str(orientation)}


def exposed_attributes(attributes: Mapping[str, str], tags: Tags) -> dict[str, str]:
    """Return the attribute of an image's tags with the exposure that the chain has applied."""
    exposure_values = {"exposure": tags.exposure, "bias": tags.bias}
    return {"exif": json.dumps({**json.loads(attributes.get("exif", "{}")), **exposure_values})}


def from_attributes(attributes: Mapping[str, str], default: Tags) -> tuple[Tags, int]:
    """Return the tags and the orientation in an image's attributes.

    Missing tags are taken from ``default``. A missing orientation is upright.

    Raises:
        ImageError: the attributes are damaged.
    """
    try:
        stored = json.loads(attributes.get("exif", "{}"))
        tags = _adapter().validate_python({**vars(default), **stored})
    except (ValueError, TypeError):
        raise ImageError(DAMAGED) from None
    return tags, orientation_of(attributes)


@cache
def _adapter() -> TypeAdapter[Tags]:
    return TypeAdapter(Tags)  # cached, because it takes a millisecond


def sensor_width(focal_length: float, equivalent: float, height: int, width: int) -> float:
    """Return the longer side of a sensor in mm, from a focal length and its 35 mm equivalent.

    The equivalent follows from the ratio of diagonals, see :func:`exif`.

    >>> round(sensor_width(24.0, 36.0, 4000, 6000), 1)
    24.0
    """
    diagonal = FILM_DIAGONAL * focal_length / equivalent
    return diagonal * max(height, width) / math.hypot(height, width)


def orientation_of(attributes: Mapping[str, str]) -> int:
    """Return the orientation in an image's attributes (EXIF's, 1 to 8); 1 (upright) without one.

    Raises:
        ImageError: the attribute is damaged.
    """
    orientation = attributes.get("orientation", "1")
    if orientation not in map(str, FLIPS):
        raise ImageError(DAMAGED)
    return int(orientation)


# For each EXIF orientation: whether to flip left to right, to flip upside down, and then to
# transpose.
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
    """Return an image, (height, width[, channel]), rotated upright by EXIF's orientation, 1 to 8.

    >>> upright(np.array([[1, 2], [3, 4]]), 6).tolist()  # its right side is now at the bottom
    [[3, 1], [4, 2]]
    """
    mirrored, upside_down, transposed = FLIPS[orientation]
    image = image[:, ::-1] if mirrored else image
    image = image[::-1] if upside_down else image
    return np.ascontiguousarray(image.swapaxes(0, 1) if transposed else image)
