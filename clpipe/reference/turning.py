"""The streaks of a rotating camera: each pixel is the mean of the still image that it saw."""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from functools import lru_cache
from typing import Any, ClassVar

import numpy as np

from clpipe.base.errors import ImageError
from clpipe.base.types import Floats
from clpipe.reference.geometry import NO_MARGINS, Centre, Margins, centre_in
from clpipe.reference.resample import Axis, Parameters
from clpipe.reference.warp import gather

# Indices are (tap, power), see :data:`clpipe.reference.warp.FILTERS`.
BILINEAR = np.array([[1, -1], [0, 1]], np.float32)
SPACING = 0.5  # px; the largest distance between the positions that make up a streak


@dataclass(frozen=True)
class CameraRotation:
    """A camera that rotates evenly about an axis in its image plane.

    In the middle of the exposure, the image is unchanged. Let a point be at (u, v), in focal
    lengths from the image centre, along and across the direction in which the centre moves. After a
    rotation t it is at ((u cos t + sin t) / w, v / w), w = cos t - u sin t. This is the pinhole's
    homography (Hartley and Zisserman, "Multiple view geometry", 2004, section 8.4). See
    :class:`clpipe.reference.resample.Resampler`.

    Args:
        rotation: in degrees in total, above 0.
        angle: direction in which the image centre moves, in degrees, from right towards up.
        focal_length: px; None is ``relative_focal_length``.
        relative_focal_length: the focal length over the longer side of the image.
        centre: the principal point in px from the frame's corner; None, for one coordinate or both,
            is the centre.
        margins: how far the image extends outside the frame, about whose centre it rotates.
    """

    parameters: ClassVar[Parameters] = (
        ("turns", "__global const float *restrict"),
        ("count", "uint"),
        ("focal", "float"),
        ("x", "float"),
        ("y", "float"),
        ("middle_x", "float"),
        ("middle_y", "float"),
    )

    rotation: float
    angle: float
    focal_length: float | None = None
    relative_focal_length: float | None = None
    centre: Centre = (None, None)
    margins: Margins = NO_MARGINS

    @property
    def scale(self) -> float:
        """See :attr:`Resampler.scale`."""
        return 1.0

    def resized(self, width: int, height: int) -> tuple[int, int]:
        """See :meth:`Resampler.resized`."""
        return width, height

    def values(self, width: int, height: int) -> Mapping[str, Any]:
        """See :meth:`Resampler.values`.

        Raises:
            ImageError: a corner of the image leaves the range of a pinhole camera.
        """
        turns = _rotation_table(self, 2 * self.max_distance(width, height))
        x, y = math.cos(math.radians(self.angle)), -math.sin(math.radians(self.angle))
        across, down = self.principal_point(width, height)
        places = {"x": x, "y": y, "middle_x": across - 0.5, "middle_y": down - 0.5}
        numbers = {name: np.float32(n) for name, n in places.items()}
        focal = np.float32(self.focal(width, height))
        return {"turns": turns, "count": np.uint32(len(turns) // 3), "focal": focal, **numbers}

    def focal(self, width: int, height: int) -> float:
        """Return the focal length in px, for an image of this size."""
        if self.focal_length:
            return self.focal_length
        assert self.relative_focal_length
        return self.relative_focal_length * max(self.margins.frame_size(width, height))

    def principal_point(self, width: int, height: int) -> tuple[float, float]:
        """Return the principal point, from the image's corner, px."""
        x, y = centre_in(self.centre, *self.margins.frame_size(width, height))
        return self.margins.left + x, self.margins.top + y

    def max_distance(self, width: int, height: int) -> float:
        """Return the largest distance, in px, of a pixel's light from its position in mid-exposure.

        Raises:
            ImageError: see :meth:`values`.
        """
        half_rotation = math.radians(self.rotation) / 2
        x, y = self.principal_point(width, height)
        focal = self.focal(width, height)
        u = math.hypot(max(x, width - x), max(y, height - y)) / focal  # the farthest corner
        if math.atan(u) + half_rotation > math.radians(85):
            raise ImageError(
                f"motion_blur: a rotation of {self.rotation:g} degrees at a focal length of "
                f"{focal:g} px moves the corners of {width}x{height} pixels to "
                f"{math.degrees(math.atan(u) + half_rotation):.0f} degrees from the axis; at most "
                "85 are allowed. Set a smaller rotation or a longer focal length"
            )
        w = math.cos(half_rotation) - u * math.sin(half_rotation)
        along, across = math.sin(half_rotation) * (1 + u * u) / w, u * (1 / w - 1)
        return math.hypot(along, across) * focal

    def needed(self, axis: Axis, size: tuple[int, int], start: int, stop: int) -> tuple[int, int]:
        """See :meth:`Resampler.needed`."""
        reach = math.ceil(self.max_distance(*size)) + 1
        lines = size[1] if axis == "rows" else size[0]
        return max(start - reach, 0), min(stop + reach, lines)

    def reach(self, axis: Axis, size: tuple[int, int], low: int, high: int) -> tuple[int, int]:
        """See :meth:`Resampler.reach`."""
        reach = math.ceil(self.max_distance(*size)) + 1
        return low + reach, high + reach

    def reference(self, image: Floats) -> Floats:
        """Return the blurred image, (height, width, 3) float32 in and out."""
        height, width = image.shape[:2]
        values = self.values(width, height)
        focal, x, y = values["focal"], values["x"], values["y"]
        one = np.float32(1)
        columns = np.arange(width, dtype=np.float32)
        rows = np.arange(height, dtype=np.float32)[:, None]
        px, py = (columns - values["middle_x"]) / focal, (rows - values["middle_y"]) / focal
        along, perpendicular = px * x + py * y, py * x - px * y
        total = np.zeros_like(image)
        turns = values["turns"].reshape(-1, 3)
        for sine, cosine, versine in turns:
            scale = focal / (cosine + along * sine)
            du, dv = (
                -sine * (one + along * along) * scale,
                perpendicular * (versine - along * sine) * scale,
            )
            across = np.clip(du * x - dv * y, -columns, np.float32(width - 1) - columns)
            down = np.clip(du * y + dv * x, -rows, np.float32(height - 1) - rows)
            for c in range(3):
                total[..., c] += gather(image[..., c], across, down, BILINEAR)
        return total * (one / np.float32(len(turns)))


@lru_cache(maxsize=64)
def _rotation_table(turning: CameraRotation, length: float) -> Floats:
    """Return sine, cosine and 1 minus cosine for each moment of a streak."""
    count = max(math.ceil(length / SPACING), 1)
    angles = np.deg2rad(turning.rotation) * ((np.arange(count) + 0.5) / count - 0.5)
    table = np.stack([np.sin(angles), np.cos(angles), 2 * np.sin(angles / 2) ** 2], -1)
    return np.ascontiguousarray(table, np.float32).reshape(-1)
