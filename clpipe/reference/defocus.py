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

HIDDEN = 1.0  # a weight, see aperture_taps
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
    """The places that a disc may cover, with its edge: (tap, 4) float32, by rows.

    Each is dx and dy in px from the pixel that light falls on to the one it comes from, the radius
    of the aperture's image whose edge is there (that of a circle around its corners), and the
    weight with which it stands for a surface that another hides.

    Args:
        blades: corners of the aperture, of which one is below the middle; 0 is round.
        largest: radius of a disc, in px.

    >>> aperture_taps(0, 0.75)[:, :3].astype(int).tolist()
    [[0, -1, 1], [-1, 0, 1], [0, 0, 0], [1, 0, 1], [0, 1, 1]]
    """
    reach = reach_of(largest)
    y, x = np.mgrid[-reach : reach + 1, -reach : reach + 1].astype(np.float64)
    radius = np.hypot(x, y)
    # The nearest pixels before all others.
    hidden = HIDDEN / (1 + (x * x + y * y) ** 2)
    if blades:
        sides = (2 * np.arange(blades) + 1) * np.pi / blades
        across = np.multiply.outer(np.sin(sides), x) + np.multiply.outer(np.cos(sides), y)
        radius = across.max(0) / np.cos(np.pi / blades)
    kept = radius < largest + 0.5
    taps = [x[kept], y[kept], radius[kept], hidden[kept]]
    return np.ascontiguousarray(np.stack(taps, 1), np.float32)


def reach_of(largest: float) -> int:
    """How far a disc of a radius, with the soft edge, covers pixels along a row or column, in px.

    >>> reach_of(0), reach_of(1.5), reach_of(16), reach_of(0.75)
    (0, 1, 16, 1)
    """
    return int(np.ceil(largest + 0.5)) - 1


def defocus(image: Floats, radii: Floats, taps: Floats) -> Floats:
    """Each pixel's light spread over its disc, and hidden by what is in front.

    The light of pixel q counts at p where its disc, with an edge 1 px wide, covers p, divided by
    the disc's area. Seen from p, what is around belongs to surfaces in front of p's own, to that,
    or behind it, with 1 px of radius between them. The first take what their discs cover of p's
    aperture. Of what is left, p's own surface takes the share of its disc's area where it is, of
    that where nothing in front hides it: inside the edge of something that is out of focus, light
    from behind passes by. That place is hidden in the render, and looks as what is nearest behind.

    Layers around a pixel are after Jimenez ("Next generation post processing in Call of Duty",
    SIGGRAPH 2014), what is hidden after Kraus and Strengert ("Depth-of-field rendering by pyramidal
    image processing", Eurographics 2007).

    Args:
        image: (height, width, 3).
        radii: of the discs in px, (height, width); below 0 in front of what is in focus.
        taps: see :func:`aperture_taps`.
    """
    zero, one, half = np.float32(0), np.float32(1), np.float32(0.5)
    own, size = radii, abs(radii)
    area = _area(size)
    light: Floats = np.zeros((3, *image.shape), np.float32)  # of what is in front, level and behind
    total: Floats = np.zeros((3, *radii.shape), np.float32)
    free: Floats = np.zeros(radii.shape, np.float32)
    for dx, dy, edge, hidden in taps:
        there = tap(radii, int(dx), int(dy))
        disc = abs(there)
        weight = np.clip(disc + (half - edge), zero, one) / _area(disc)
        nearer, farther = np.clip(own - there, zero, one), np.clip(there - own, zero, one)
        level = one - nearer - farther
        shares = np.stack([nearer * weight, level * weight, farther * (weight + hidden)])
        light += shares[..., None] * tap(image, int(dx), int(dy))
        total += shares
        free += (one - nearer) * (np.clip(size + (half - edge), zero, one) / area)
    in_front, level, behind = total
    left = one - np.minimum(in_front, one)
    covered = np.where(behind > 0, left * np.minimum(level / free, one), left)
    of_behind = (left - covered) / np.where(behind > 0, behind, one)
    shares = np.stack([one / np.maximum(in_front, one), covered / level, of_behind])
    return np.asarray((light * shares[..., None]).sum(0))


def _area(radius: Floats) -> Floats:
    """What a disc with a soft edge covers, in px."""
    whole = np.float32(np.pi) * (radius * radius) + np.float32(np.pi / 12)
    return np.asarray(np.maximum(radius + np.float32(0.5), whole))
