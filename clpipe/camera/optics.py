"""One camera's optics: focal length, aperture, focus, shutter, principal point.

Settings, the render's camera and the parameters of stages may state these facts. A fact that is
stated in one place is valid everywhere, and two places must agree.
"""

import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, fields, replace
from functools import cached_property
from typing import Any

from clpipe.base.errors import KeyedError, RequestError
from clpipe.camera.lens import LensCalibration

LENGTH_TOLERANCE = 0.01  # relative tolerance of lengths and f-numbers; lenses state nominal values
PIXEL_TOLERANCE = 1e-4  # relative tolerance of lengths in px

# Relative tolerance of a lens's focal length; makers round it, and aspect ratios differ.
FOCAL_TOLERANCE = 0.1
FILM_WIDTH, FILM_DIAGONAL = 36.0, math.hypot(36, 24)  # mm; the width and diagonal of 35 mm film

DEFAULT_EXPOSURE_TIME = 0.01  # s

IN_PIXELS = ("fx", "fy", "cx", "cy")


@dataclass(frozen=True)
class Optics:
    """Facts of a camera's optics; None is not known.

    Args:
        fx, fy: focal lengths in px of the render.
        focal_length: in mm.
        sensor_width: in mm, along the longer side of the image.
        pixel_pitch: distance of the image's pixels on the sensor, um.
        camera_angle_x: horizontal angle of view of the render, in radians.
        cx, cy: the principal point in px from the upper left corner of the render.
        f_number: of the aperture.
        focus_distance: in m.
        exposure_time: in s.
        calibration: the calibration of the lens with the stated name.
        has_lens_sensor: whether the sensor's width is not stated and is that of the lens's
            camera, for a 3:2 image; see :meth:`for_image`.
        places: where each of them is stated.
    """

    fx: float | None = None
    fy: float | None = None
    focal_length: float | None = None
    sensor_width: float | None = None
    pixel_pitch: float | None = None
    camera_angle_x: float | None = None
    cx: float | None = None
    cy: float | None = None
    f_number: float | None = None
    focus_distance: float | None = None
    exposure_time: float | None = None
    calibration: LensCalibration | None = None
    has_lens_sensor: bool = False
    places: Mapping[str, str] = field(default_factory=dict)

    @classmethod
    def of(cls, stated: Iterable[tuple[str, str, float]]) -> "Optics":
        """Return the optics of statements: the place of each, the name of the fact, its value.

        Raises:
            KeyedError: two contradict each other; the message contains both places.

        >>> Optics.of([("render.focal_length", "focal_length", 35.0)]).focal_length
        35.0
        """
        values: dict[str, Any] = {}
        places: dict[str, str] = {}
        for place, name, value in stated:
            known = values.setdefault(name, value)
            first = places.setdefault(name, place)
            in_px = name in IN_PIXELS
            tolerance, least = (PIXEL_TOLERANCE, 0.01) if in_px else (LENGTH_TOLERANCE, 0.0)
            if value is known or _agree(value, known, tolerance, least):
                continue
            raise KeyedError(
                place, f"{place}: {value:g} contradicts {first}: {known:g}; set one of them"
            )
        return cls(**values, places=places)

    def with_lens(self, lens: LensCalibration) -> "Optics":
        """Return a copy with a lens: its focal length, and its sensor if no width is stated.

        >>> Optics().with_lens(LensCalibration("a", 50.0, {}, {}, crop_factor=1.5)).sensor_width
        24.0
        """
        places = {"focal_length": "lens", **self.places}
        updated = replace(self, calibration=lens, focal_length=lens.focal_length, places=places)
        stated = self.fx, self.sensor_width, self.pixel_pitch, self.camera_angle_x
        if any(each is not None for each in stated):
            return updated
        width = FILM_WIDTH / lens.crop_factor
        places = {**places, "sensor_width": "the sensor of its camera"}
        return replace(updated, sensor_width=width, has_lens_sensor=True, places=places)

    def for_image(self, width: int, height: int) -> dict[str, float]:
        """Return the known facts for an image of this size in px, by the names of the fields.

        The sensor of a named lens has the diagonal from lensfun, whatever the shape of the image.

        Raises:
            RequestError: the stated focal length in px does not fit the lens and this image.
        """
        known, lens = self.known, self.calibration
        if lens is None:
            return known
        sensor = FILM_DIAGONAL / lens.crop_factor * max(width, height) / math.hypot(width, height)
        if self.has_lens_sensor:
            known["sensor_width"] = sensor
        lens_fx, fx = lens.focal_length / sensor * max(width, height), self.fx
        if self.camera_angle_x:
            fx = width / 2 / math.tan(self.camera_angle_x / 2)
        stated = None if self.has_lens_sensor else self.sensor_width or self.pixel_pitch
        if fx and not stated and abs(fx - lens_fx) > FOCAL_TOLERANCE * lens_fx:
            place = self.places.get("fx") or self.places.get("camera_angle_x")
            raise RequestError(
                f"{place}: the focal length of this render of {width}x{height} pixels is "
                f"{fx:.0f} px, but lens: {lens.name} at {lens.focal_length:g} mm gives "
                f"{lens_fx:.0f} px on its camera's sensor, {sensor:.1f} mm wide. Use a matching "
                "lens, or set render.sensor_width for another sensor"
            )
        return known

    @cached_property
    def known(self) -> dict[str, float]:
        """Return the known numbers, by their names."""
        return {name: value for name in OPTICS_NAMES if (value := getattr(self, name)) is not None}

    def without_view(self) -> "Optics":
        """Return a copy without focal length, sensor and principal point."""
        cleared: dict[str, Any] = dict.fromkeys(
            (*IN_PIXELS, "focal_length", "sensor_width", "camera_angle_x")
        )
        return replace(self, **cleared, has_lens_sensor=False)

    def set_to(self, used: Mapping[str, float]) -> "Optics":
        """Return a copy with the aperture and focus of a step, unless others are known.

        A step's defaults are therefore also the defaults of later steps, and those in EXIF.
        """
        used_values = {name: used.get(name) for name in ("f_number", "focus_distance")}
        missing: dict[str, Any] = {
            name: v for name, v in used_values.items() if v and getattr(self, name) is None
        }
        return replace(self, **missing) if missing else self


def _agree(one: float, two: float, relative: float, absolute: float) -> bool:
    """Like math.isclose, with operators only."""
    return abs(one - two) <= max(relative * max(abs(one), abs(two)), absolute)


NOT_NUMBERS = ("calibration", "has_lens_sensor", "places")
OPTICS_NAMES = tuple(f.name for f in fields(Optics) if f.name not in NOT_NUMBERS)
