"""An image of a panorama through a wide lens: the position in the atlas for each pixel."""

from collections.abc import Mapping
from dataclasses import dataclass
from functools import lru_cache
from typing import Any, ClassVar

import numpy as np

from clpipe.base.errors import ImageError
from clpipe.base.types import Array, Floats
from clpipe.reference.geometry import ForwardMapped
from clpipe.reference.intrinsics import FOCAL_TOLERANCE, Intrinsics
from clpipe.reference.panorama import CUBE, FRONT, LatitudeLongitude, Panorama, View, Views
from clpipe.reference.resample import PADDING, Axis, Parameters
from clpipe.reference.warp import FILTERS, GatherResampler, gather, with_mirrored_lines
from clpipe.reference.wide import WideLens

FACE_SAMPLES = 256  # positions across the picture at which visible faces are searched

OUTSIDE = -1e6  # px; marks positions outside every image

OpticsValues = tuple[tuple[str, float], ...]


@dataclass(frozen=True)
class Projection(GatherResampler, ForwardMapped):
    """How a wide-angle image is made from an input: its geometry, and its resampling.

    It is a :class:`~clpipe.reference.geometry.Geometry`, and a
    :class:`~clpipe.reference.resample.Resampler`.

    Args:
        lens: the lens.
        filter: a key of :data:`clpipe.reference.warp.FILTERS`.
        panorama: the layout of the input; None is a single view ahead, or a map.
        is_map: whether it is a map of longitude and latitude, without a border.
        angle: horizontal field of view of a single view, in degrees.
        shot: known values of the camera of a single view, see :meth:`Intrinsics.of_render`.
    """

    parameters: ClassVar[Parameters] = (
        ("across", "__global const float *restrict"),
        ("down", "__global const float *restrict"),
        ("pitch", "uint"),
        ("lines", "uint"),
    )

    lens: WideLens
    filter: str
    panorama: Panorama | None = None
    is_map: bool = False
    angle: float | None = None
    shot: OpticsValues = ()

    def panorama_for(self, width: int, height: int) -> Panorama:
        """Return the layout of an image of some size.

        Raises:
            ImageError: the focal length of a view is not known, or contradicts another.
        """
        if self.panorama:
            self._check(self.panorama)
            return self.panorama
        if self.is_map:
            return LatitudeLongitude(width, height, border=0)
        if self.angle:
            single = Views((View.from_angle(FRONT, width, height, self.angle),), border=0)
            self._check(single)
            return single
        known = Intrinsics.of_render(width, height, dict(self.shot))
        if known is None:
            raise ImageError(
                "projection: the focal length of the render is not known. Set render.fx, or "
                "render.focal_length and render.sensor_width, or projection.face_angle. Or use "
                "the six faces of a cube: *_front, *_right, *_back, *_left, *_up and *_down"
            )
        place = known.fx, known.fy, known.cx, known.cy
        return Views((View(FRONT, *place, width, height),), border=0)

    def _check(self, panorama: Panorama) -> None:
        """Check that the known focal length of the render agrees with a panorama.

        Raises:
            ImageError: it does not.
        """
        if not isinstance(panorama, Views):
            return
        view = panorama.views[0]
        known = Intrinsics.of_render(view.width, view.height, dict(self.shot))
        if known and abs(known.fx - view.fx) > FOCAL_TOLERANCE * view.fx:
            raise ImageError(
                f"projection: render's focal length is {known.fx:.4g} px, but a view of "
                f"{view.width}x{view.height} pixels with this angle has {view.fx:.4g} px; "
                "remove the focal length or the angle"
            )

    def size(self, width: int, height: int) -> tuple[int, int]:
        """See :meth:`Geometry.size`."""
        return self.lens.picture

    def resized(self, width: int, height: int) -> tuple[int, int]:
        """See :meth:`Resampler.resized`."""
        return self.lens.picture

    def origins(self, x: Array, y: Array, width: int, height: int) -> tuple[Array, Array]:
        """See :meth:`Geometry.origins`; NaN outside the field of view, and outside all views."""
        return self.panorama_for(width, height).positions(self.lens.rays(x, y))

    def destinations(
        self, x: Array, y: Array, at: tuple[Array, Array], width: int, height: int
    ) -> tuple[Array, Array]:
        """See :meth:`ForwardMapped.destinations`."""
        return self.lens.project(self.panorama_for(width, height).rays(x, y, at))

    def intrinsics(self, known: Intrinsics | None, width: int, height: int) -> Intrinsics | None:
        """See :meth:`Geometry.intrinsics`; those of the lens, whatever the input's are."""
        return self.lens.intrinsics()

    def values(self, width: int, height: int) -> Mapping[str, Any]:
        """See :meth:`Resampler.values`."""
        across, down = _offsets(self, width, height)
        lines, pitch = across.shape
        flat = {"across": across.reshape(-1), "down": down.reshape(-1)}
        return {**flat, "pitch": np.uint32(pitch), "lines": np.uint32(lines)}

    def lines(self, axis: Axis, width: int, height: int) -> tuple[Array, Array]:
        return _lines(self, axis, width, height)

    def reference(self, image: Floats) -> Floats:
        """Return the image, (height, width, 3) float32, of an input; black outside the view."""
        height, width = image.shape[:2]
        columns, rows = self.lens.picture
        across, down = (each[:rows, :columns] for each in _offsets(self, width, height))
        channels = [gather(image[..., c], across, down, FILTERS[self.filter]) for c in range(3)]
        return np.stack(channels, -1)


def visible_faces(lens: WideLens) -> tuple[int, list[str]]:
    """Return the side in px of cube faces as fine as an image, and the faces that it shows."""
    cube = Views(
        tuple(
            View.from_angle(rotation, FACE_SAMPLES, FACE_SAMPLES, 90.0)
            for rotation in CUBE.values()
        )
    )
    width, height = lens.picture
    x, y = np.meshgrid(np.linspace(0, width, FACE_SAMPLES), np.linspace(0, height, FACE_SAMPLES))
    _, row = cube.positions(lens.rays(x, y))
    numbers = np.unique(row[np.isfinite(row)] * len(CUBE) // cube.size[1])
    # A face is coarsest at its centre, where one radian is half its side.
    side = 2 * int(np.ceil(lens.finest))
    return side, [list(CUBE)[int(number)] for number in numbers]


@lru_cache(maxsize=4)
def _offsets(projection: Projection, width: int, height: int) -> tuple[Floats, Floats]:
    """Return the offset from each pixel to the position that it shows, across and down, in px.

    The arrays are float32, (height, width) of the image plus :data:`PADDING` each, which a kernel
    reads.
    """
    columns, rows = (each + PADDING for each in projection.lens.picture)
    across, down = (np.full((rows, columns), OUTSIDE, np.float32) for _ in range(2))
    block = max((1 << 20) // columns, 1)
    for top in range(0, rows - PADDING, block):
        part = slice(top, min(top + block, rows - PADDING))
        y, x = np.mgrid[part, 0 : columns - PADDING] + 0.5
        position = projection.origins(x, y, width, height)
        is_visible = np.isfinite(position[0])
        across[part, : x.shape[1]] = np.where(is_visible, position[0] - x, OUTSIDE)
        down[part, : x.shape[1]] = np.where(is_visible, position[1] - y, OUTSIDE)
    return across, down


@lru_cache(maxsize=8)
def _lines(projection: Projection, axis: Axis, width: int, height: int) -> tuple[Array, Array]:
    """See :meth:`GatherResampler.lines`."""
    columns, rows = projection.lens.picture
    number, size = (1, height) if axis == "rows" else (0, width)
    offsets = _offsets(projection, width, height)[number][:rows, :columns]
    is_visible = offsets > OUTSIDE / 2
    positions = offsets + (np.arange(rows)[:, None] if number else np.arange(columns))
    first = np.where(is_visible, positions, np.inf).min(number)
    last = np.where(is_visible, positions, -np.inf).max(number)
    support = projection.support
    same = np.arange(len(first)) * size // len(first)
    first = np.where(np.isinf(first), same, np.floor(first) - support)
    last = np.where(np.isinf(last), same, np.floor(last) + support + 1)
    return with_mirrored_lines(first, last, size, support)
