"""Light spread by how far its surface is from focus: twin of ``kernels/defocus.cl``."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import lru_cache
from typing import Any

import numpy as np

from clpipe.base.cache import BoundedCache
from clpipe.base.errors import ImageError
from clpipe.base.types import Array, Floats
from clpipe.reference.image import tap

FAR = 1e9  # from here on a surface is infinitely far; Blender's sky is at 1e10


@dataclass(frozen=True, eq=False)
class Depth:
    """How far what each pixel shows is from the camera.

    Args:
        pixels: (height, width), above 0, in any unit; infinite where there is nothing.
        record: what a sidecar says of where it is from.
        derived: what follows from it, by what that depends on; renditions share it.
    """

    pixels: Floats
    record: Mapping[str, Any] = field(default_factory=dict)
    derived: BoundedCache[Any] = field(default_factory=lambda: BoundedCache(2))


NOWHERE = Depth(np.full((1, 1), np.inf, np.float32))


def checked_depth(pixels: Array) -> Floats:
    """Depth as it was stored, (height, width), made float32.

    0, which Mitsuba writes where a ray meets nothing, and :data:`FAR` and more become infinite.

    Raises:
        ImageError: NaN or negative numbers are in it; the message says how many, and where.
    """
    depth = np.array(pixels, np.float32)
    wrong = ~(depth >= 0)
    if count := np.count_nonzero(wrong):
        y, x = np.unravel_index(int(np.argmax(wrong)), depth.shape)
        raise ImageError(
            f"its depth is NaN or negative in {count} pixels, first {depth[y, x]:g} at column {x}, "
            f"row {y}; depth is above 0, and infinite, {FAR:g} or more or 0 where there is nothing"
        )
    depth[(depth == 0) | (depth >= FAR)] = np.inf
    return depth


@lru_cache(maxsize=64)
def aperture_taps(blades: int, largest: float) -> Floats:
    """The places that a disc may cover, with its edge: (tap, 3) float32, by rows.

    Each is dx and dy in px from the pixel that light falls on to the one it comes from, and the
    radius of the aperture's image whose edge is there: that of a circle around its corners.

    Args:
        blades: corners of the aperture, of which one is below the middle; 0 is round.
        largest: radius of a disc, in px.

    >>> aperture_taps(0, 0.75).astype(int).tolist()
    [[0, -1, 1], [-1, 0, 1], [0, 0, 0], [1, 0, 1], [0, 1, 1]]
    """
    reach = reach_of(largest)
    y, x = np.mgrid[-reach : reach + 1, -reach : reach + 1].astype(np.float64)
    radius = np.hypot(x, y)
    if blades:
        sides = (2 * np.arange(blades) + 1) * np.pi / blades
        across = np.multiply.outer(np.sin(sides), x) + np.multiply.outer(np.cos(sides), y)
        radius = across.max(0) / np.cos(np.pi / blades)
    kept = radius < largest + 0.5
    return np.ascontiguousarray(np.stack([x[kept], y[kept], radius[kept]], 1), np.float32)


def reach_of(largest: float) -> int:
    """How far a disc of a radius, with the soft edge, covers pixels along a row or column, in px.

    >>> reach_of(0), reach_of(1.5), reach_of(16), reach_of(0.75)
    (0, 1, 16, 1)
    """
    return int(np.ceil(largest + 0.5)) - 1


def defocus(image: Floats, radii: Floats, taps: Floats) -> Floats:
    """Each pixel's light spread over its disc.

    The light of pixel q counts at p where its disc, with an edge 1 px wide, covers p, divided by
    the disc's area. What lies behind p counts with the smaller disc of both, so that what is sharp
    hides it.

    Args:
        image: (height, width, 3).
        radii: of the discs in px, (height, width); below 0 in front of what is in focus.
        taps: see :func:`aperture_taps`.
    """
    half, third, circle = np.float32(0.5), np.float32(np.pi / 12), np.float32(np.pi)
    own, size = radii, abs(radii)
    light: Floats = np.zeros(image.shape, np.float32)
    total: Floats = np.zeros(radii.shape, np.float32)
    for dx, dy, edge in taps:
        there = tap(radii, int(dx), int(dy))
        disc = abs(there)
        disc = np.where(there > own, np.minimum(disc, size), disc)
        cover = np.clip(disc + (half - edge), np.float32(0), np.float32(1))
        weight = cover / np.maximum(disc + half, circle * (disc * disc) + third)
        light += weight[..., None] * tap(image, int(dx), int(dy))
        total += weight
    return np.asarray(light / total[..., None])
