"""Attributes in the headers of image files: clpipe's own, and OpenEXR's standard ones."""

import contextlib
from pathlib import Path
from typing import Any

from clpipe.base.errors import ImageError
from clpipe.images.openimageio import open_image

PREFIX = "clpipe:"  # of the names of clpipe's own attributes


def own_attributes(spec: Any) -> dict[str, str]:
    """clpipe's own attributes in an OpenImageIO spec, by their names without the prefix."""
    return {
        attribute.name.removeprefix(PREFIX): str(attribute.value)
        for attribute in spec.extra_attribs
        if attribute.name.startswith(PREFIX)
    }


def read_attributes(path: Path) -> dict[str, str]:
    """clpipe's own attributes of a file; none where it is missing, unreadable or not clpipe's."""
    with contextlib.suppress(ImageError), open_image(path) as file:
        return own_attributes(file.spec())
    return {}


def shot_attributes(spec: Any) -> dict[str, float]:
    """What OpenEXR's standard attributes say of the shot; values that cannot be are left out.

    The names are those of :class:`clpipe.images.encoding.Output`: exposure_time in s, focal_length
    and sensor_width in mm.
    """
    size = spec.getattribute("sensorOverallDimensions")
    values = {
        "exposure_time": spec.getattribute("ExposureTime"),
        "focal_length": spec.getattribute("effectiveFocalLength")
        or spec.getattribute("nominalFocalLength"),
        "sensor_width": max(size) if isinstance(size, tuple) else None,
    }
    return {k: v for k, v in values.items() if isinstance(v, float) and 0 < v <= 10_000}
