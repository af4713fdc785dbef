"""Depth of field: what is nearer or farther than the focus is spread over discs."""

from collections.abc import Mapping
from typing import Any, ClassVar, Self

import numpy as np
from pydantic import field_validator, model_validator

from clpipe.base.types import Floats
from clpipe.reference.defocus import NOWHERE, Depth, aperture_taps, defocus, reach_of
from clpipe.stage import (
    Argument,
    Context,
    Kind,
    Method,
    Pass,
    ReferenceContext,
    Stage,
    Stencil,
    Unchanged,
    parameter,
)

LARGEST = 31  # px, of a disc's radius
VECTOR = 16  # lanes at most


class InFocus(Unchanged):
    """No depth of field: everything is in focus."""

    method: ClassVar = "none"
    summary: ClassVar = "everything is in focus"


class ThinLens(Method):
    """A thin lens: a point at distance z is spread over a disc of diameter c.

    c = f^2 |z - zf| / (N z (zf - f)), with focal length f, f-number N and focus distance zf
    (Potmesil and Chakravarty, SIGGRAPH 1981). Depth is measured along the axis of view. Light is
    gathered from the discs around; see :func:`clpipe.reference.defocus.defocus`.

    >>> lens = ThinLens(focal_length=50.0, f_number=2.0, focus_distance=2.0, pixel_pitch=10.0)
    >>> lens.radii(np.float32([[1.0, 2.0, 4.0, np.inf]])).astype(int).tolist()
    [[-32, 0, 16, 32]]
    """

    method: ClassVar = "thin_lens"
    kernel: ClassVar = "defocus"
    overscan: ClassVar = True
    summary: ClassVar = "a thin lens, by a depth channel"
    tolerance: ClassVar = 1e-5
    example: ClassVar = {"max_radius": 3}
    alternatives: ClassVar = frozenset({"sensor_width", "pixel_pitch"})

    focal_length: float = parameter(50.0, "Focal length.", "mm", gt=0, le=2000)
    f_number: float = parameter(2.8, "f-number of the aperture.", ge=0.5, le=64)
    focus_distance: float = parameter(
        3.0, "Distance that is in focus, in the unit of the depth.", gt=0, le=1e9
    )
    depth_scale: float = parameter(1.0, "Metres in a unit of the depth.", "m", gt=0, le=1e6)
    sensor_width: float | None = parameter(
        None, "Width of the sensor, all of which the picture shows.", "mm", "none", gt=0, le=1000
    )
    pixel_pitch: float | None = parameter(
        None,
        "Distance of the image's pixels on the sensor, in place of its width.",
        "um",
        "from sensor_width, else the camera",
        gt=0,
        le=1000,
    )
    blades: int = parameter(0, "Blades of the aperture, 5 to 9; 0 is round.", ge=0, le=9)
    max_radius: int = parameter(
        16,
        "The largest radius of a disc; larger ones become as large.",
        "px",
        structural=True,
        ge=1,
        le=LARGEST,
    )
    layer: str = parameter("", "The layer that has the depth; else one of a usual name.")

    @field_validator("blades")
    @classmethod
    def _closed(cls, blades: int) -> int:
        if blades in range(1, 5):
            raise ValueError("an aperture has 5 to 9 blades, or 0 for a round one")
        return blades

    @model_validator(mode="after")
    def _in_front(self) -> "ThinLens":
        distance = self.focus_distance * self.depth_scale * 1000
        if distance <= self.focal_length:
            raise ValueError(
                f"focus_distance {self.focus_distance:g} is {distance:g} mm, which is not beyond "
                f"the focal length of {self.focal_length:g} mm; is depth_scale right?"
            )
        if self.sensor_width and self.pixel_pitch:
            raise ValueError("sensor_width and pixel_pitch both give the pixels' size; set one")
        return self

    def resolve(self, context: Context) -> Self:
        if self.sensor_width:
            return self
        if not (pitch := self.pixel_pitch or context.camera.pixel_pitch):
            raise ValueError(
                f"sensor_width: the size of pixels is needed, and camera {context.camera.name} "
                "does not say it; set it in mm, or pixel_pitch in um"
            )
        return self.with_defaults(pixel_pitch=pitch)

    def passes(self) -> tuple[Pass, ...]:
        given = ("radii", "columns", "rows", "reach", "taps", "count")
        return (Pass("defocus", Stencil(self.max_radius), given),)

    def radii(self, depth: Floats) -> Floats:
        """The radii of discs in px, below 0 in front of the focus, as large as they may be.

        Args:
            depth: (height, width) of the whole image, above 0; it may be infinite.
        """
        focus, metre = self.focus_distance * self.depth_scale * 1000, 1000.0
        width, _ = self.margins.inside(depth.shape[1], depth.shape[0])
        pitch = self.sensor_width / width if self.sensor_width else (self.pixel_pitch or 0.0) / 1000
        widest = self.focal_length**2 / (self.f_number * (focus - self.focal_length)) / pitch / 2
        nearness = np.float32(focus / (self.depth_scale * metre)) / depth
        return np.asarray(np.float32(widest) * (1 - nearness))

    def clipped(self, depth: Floats) -> Floats:
        """The radii that are used, see :meth:`radii`: none above ``max_radius``."""
        return np.clip(self.radii(depth), -self.max_radius, self.max_radius)

    def arguments(self, context: Context) -> Mapping[str, Argument]:
        depth = _depth_in(context)
        if self not in depth.derived:
            radii = self.clipped(depth.pixels)
            largest = float(np.ceil(abs(radii).max() * 4)) / 4  # few tables for many images
            reach = reach_of(largest)
            around = ((reach, reach), (reach, reach + VECTOR))
            taps = aperture_taps(self.blades, largest)
            depth.derived[self] = np.pad(radii, around, "reflect"), reach, taps
        radii, reach, taps = depth.derived[self]
        return {
            "radii": radii,
            "columns": np.int32(radii.shape[1]),
            "rows": np.int32(radii.shape[0]),
            "reach": np.int32(reach),
            "taps": taps,
            "count": np.int32(len(taps)),
        }

    def reference(self, image: Floats, given: ReferenceContext) -> Floats:
        taps = self.arguments(given.context)["taps"]
        depth = np.broadcast_to(_depth_in(given.context).pixels, image.shape[:2])
        radii = self.clipped(depth)
        assert isinstance(taps, np.ndarray)
        return defocus(image, radii, taps)


def _depth_in(context: Context) -> Depth:
    """The depth of the image; where there is no image yet, everything is infinitely far."""
    if context.depth is None:
        return NOWHERE
    depth: Any = context.depth()
    assert depth is not None, "the image is still there"
    return depth


STAGE = Stage("defocus", "Blur what is out of focus.", Kind.RGB, Kind.RGB, (InFocus, ThinLens))
