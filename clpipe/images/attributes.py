"""Attributes in the headers of image files: clpipe's own, and OpenEXR's standard ones."""

import contextlib
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from clpipe.base.errors import ImageError
from clpipe.images.openimageio import open_image
from clpipe.images.tags import DATE_PATTERN, FLIPS, sensor_width, shot_to_attributes

SHOT_OF_TAGS = {"exposure_time": "exposure", "focal_length": "focal_length"}
PREFIX = "clpipe:"  # prefix of clpipe's attribute names


def clpipe_attributes(spec: Any) -> dict[str, str]:
    """Return clpipe's own attributes in an OpenImageIO spec, by their names without the prefix."""
    return {
        attribute.name.removeprefix(PREFIX): str(attribute.value)
        for attribute in spec.extra_attribs
        if attribute.name.startswith(PREFIX)
    }


def read_attributes(path: Path) -> dict[str, str]:
    """Return clpipe's own attributes of a file; {} if it is missing, unreadable or has none."""
    with contextlib.suppress(ImageError), open_image(path) as file:
        return clpipe_attributes(file.spec())
    return {}


def shot_attributes(spec: Any) -> dict[str, float]:
    """Return the shot from OpenEXR's standard attributes, without impossible values.

    The names come from a render's camera (``[render]``): exposure_time in s, focal_length
    and sensor_width in mm.
    """
    size = spec.getattribute("sensorOverallDimensions")
    values = {
        "exposure_time": spec.getattribute("ExposureTime"),
        "focal_length": spec.getattribute("effectiveFocalLength")
        or spec.getattribute("nominalFocalLength"),
        "sensor_width": max(size) if isinstance(size, tuple) else None,
    }
    return _plausible(values)


def photograph_attributes(spec: Any) -> tuple[dict[str, str], dict[str, float]]:
    """Return the shot from the EXIF of a finished picture, without impossible values.

    The camera and its ISO are omitted, because clpipe simulates another camera.

    Returns:
        The attributes that contain the tags and the orientation of an image, and the values of
        :func:`shot_attributes`. The sensor's width is known if EXIF has the equivalent focal
        length on 35 mm film.
    """
    stated = {
        "exposure": spec.getattribute("ExposureTime"),
        "aperture": spec.getattribute("FNumber"),
        "focal_length": spec.getattribute("Exif:FocalLength"),
    }
    values = _plausible(stated)
    shot = {name: values[key] for name, key in SHOT_OF_TAGS.items() if key in values}
    equivalent = spec.getattribute("Exif:FocalLengthIn35mmFilm")
    if isinstance(equivalent, int) and 0 < equivalent <= 10_000 and "focal_length" in values:
        length = values["focal_length"]
        shot["sensor_width"] = sensor_width(length, equivalent, spec.height, spec.width)
    taken = str(spec.getattribute("Exif:DateTimeOriginal") or "")
    tags: dict[str, float | str] = {**values}
    if DATE_PATTERN.fullmatch(taken):
        tags["taken"] = taken
    orientation = spec.getattribute("Orientation")
    orientation_ = orientation if orientation in FLIPS else 1
    return shot_to_attributes(tags, orientation_), shot


def _plausible(values: Mapping[str, Any]) -> dict[str, float]:
    return {k: v for k, v in values.items() if isinstance(v, float) and 0 < v <= 10_000}
