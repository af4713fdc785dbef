"""TODO."""

import contextlib
import json
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import OpenImageIO as oiio
from pydantic import TypeAdapter

from clpipe.base.errors import ImageError
from clpipe.base.types import Array
from clpipe.camera.profile import Positive
from clpipe.images.encoding import Output

ATTRIBUTES = "clpipe:"  # what the names of our own begin with


def _attributes(spec: Any) -> dict[str, str]:
    """clpipe's own attributes of a part."""
    return {
        a.name.removeprefix(ATTRIBUTES): str(a.value)
        for a in spec.extra_attribs
        if a.name.startswith(ATTRIBUTES)
    }


def shot_of(spec: Any) -> dict[str, float]:
    """What OpenEXR's standard attributes say of a shot, as far as it can be true."""
    size = spec.getattribute("sensorOverallDimensions")
    said = {
        "exposure_time": spec.getattribute("ExposureTime"),
        "focal_length": spec.getattribute("effectiveFocalLength")
        or spec.getattribute("nominalFocalLength"),
        "sensor_width": max(size) if isinstance(size, tuple) else None,
    }
    return {k: v for k, v in said.items() if isinstance(v, float) and 0 < v <= 10_000}


def read_attributes(path: Path) -> dict[str, str]:
    """The attributes that clpipe gave to a kept image; none if the file is no such image."""
    file = oiio.ImageInput.open(str(path)) if path.is_file() else None
    with contextlib.suppress(UnicodeDecodeError):
        if file is None:
            oiio.geterror()  # it would be told at the next call
            return {}
        with contextlib.closing(file):
            return _attributes(file.spec())
    return {}


@dataclass(frozen=True)
class Tags:
    """What goes into a picture's EXIF, and how it is encoded; None is not known."""

    make: str
    model: str
    iso: Positive
    exposure: Positive | None = None  # s
    aperture: Positive | None = None
    focal_length: Positive | None = None  # mm
    taken: str = ""  # "YYYY:MM:DD HH:MM:SS"
    output: Output = field(default_factory=Output)

    @property
    def shot(self) -> dict[str, float]:
        """What is known of the shot, by the names of :class:`clpipe.images.encoding.Output`."""
        found = {"exposure_time": self.exposure, "focal_length": self.focal_length}
        return {name: value for name, value in found.items() if value}


CARRIED = ("exif", "orientation")  # attributes that go with an image from stage to stage


def carry(tags: Tags, orientation: int) -> dict[str, str]:
    """The attributes by which an image carries its tags and its orientation (as EXIF has it)."""
    own = {name: value for name, value in asdict(tags).items() if name != "output"}
    return {"exif": json.dumps(own), "orientation": str(orientation)}


def carried(attributes: Mapping[str, str], otherwise: Tags) -> tuple[Tags, int]:
    """The tags and the orientation that an image carries; where none, others, and upright.

    Raises:
        ImageError: they are damaged.
    """
    try:
        text = attributes.get("exif")
        tags = TypeAdapter(Tags).validate_json(text) if text else otherwise
        orientation = int(attributes.get("orientation", 1))
        if orientation not in FLIPS:
            raise ValueError
    except ValueError:
        raise ImageError("its attributes clpipe:exif and clpipe:orientation are damaged") from None
    return tags, orientation


# By EXIF's orientation: whether to flip left to right, upside down, and then to transpose.
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
    """An image, (height, width[, channel]), turned as EXIF's orientation says.

    >>> upright(np.array([[1, 2], [3, 4]]), 6).tolist()  # its right side is now at the bottom
    [[3, 1], [4, 2]]
    """
    mirrored, upside_down, transposed = FLIPS[orientation]
    image = image[:, ::-1] if mirrored else image
    image = image[::-1] if upside_down else image
    return np.ascontiguousarray(image.swapaxes(0, 1) if transposed else image)
