"""Depth of field from the distance to the focus: the counterpart of ``kernels/defocus.cl``."""

from functools import lru_cache

import numpy as np

from clpipe.base.errors import ImageError
from clpipe.base.types import Array, Floats
from clpipe.reference.image import tap

HIDDEN_WEIGHT = 1.0  # see aperture_taps
FAR = 1e9  # distance from which a surface counts as infinitely far; Blender's sky is at 1e10


def parse_depth(pixels: Array) -> Floats:
    """Convert a stored depth, (height, width), to float32.

    Values of :data:`FAR` and more become infinite. So does 0, which Mitsuba writes for rays without
    a hit.

    Raises:
        ImageError: it contains NaN or negative numbers; the message states how many, and where.
    """
    depth = np.array(pixels, np.float32)
    wrong = ~(depth >= 0)
    if count := np.count_nonzero(wrong):
        y, x = np.unravel_index(int(np.argmax(wrong)), depth.shape)
        raise ImageError(
            f"its depth is NaN or negative in {count} pixels, first {depth[y, x]:g} at column "
            f"{x}, row {y}. Depth is above 0, or it is infinite, {FAR:g} or more, or 0 where "
            "there is no surface"
        )
    depth[(depth == 0) | (depth >= FAR)] = np.inf
    return depth


@lru_cache(maxsize=64)
def aperture_taps(blades: int, largest: float) -> Floats:
    """Return the positions that a disc may cover, with its edge: (tap, 4) float32, by rows.

    The first two numbers are dx and dy in px, from the pixel that receives light to its source.
    The third number is the radius at which the edge of the aperture's image reaches it, measured by
    the circle around its corners. The last number is the weight with which it replaces a hidden
    surface.

    Args:
        blades: corners of the aperture, one of which points down; 0 is round.
        largest: radius of a disc, in px.

    >>> aperture_taps(0, 0.75)[:, :3].astype(int).tolist()
    [[0, -1, 1], [-1, 0, 1], [0, 0, 0], [1, 0, 1], [0, 1, 1]]
    """
    reach = disc_reach(largest)
    y, x = np.mgrid[-reach : reach + 1, -reach : reach + 1].astype(np.float64)
    radius = np.hypot(x, y)
    # The nearest pixels have by far the largest weights.
    hidden = HIDDEN_WEIGHT / (1 + (x * x + y * y) ** 2)
    if blades:
        sides = (2 * np.arange(blades) + 1) * np.pi / blades
        projection = np.multiply.outer(np.sin(sides), x) + np.multiply.outer(np.cos(sides), y)
        radius = projection.max(0) / np.cos(np.pi / blades)
    kept = radius < largest + 0.5
    taps = [x[kept], y[kept], radius[kept], hidden[kept]]
    return np.ascontiguousarray(np.stack(taps, 1), np.float32)


def disc_reach(largest: float) -> int:
    """Return how far a disc with its soft edge extends along a row or column, in px.

    >>> disc_reach(0), disc_reach(1.5), disc_reach(16), disc_reach(0.75)
    (0, 1, 16, 1)
    """
    return int(np.ceil(largest + 0.5)) - 1


def defocus(image: Floats, radii: Floats, taps: Floats) -> Floats:
    """Spread each pixel's light over its disc, and hide it by nearer surfaces.

    The light of pixel q contributes to p if q's disc, with an edge 1 px wide, covers p. It is
    divided by the disc's area. Surfaces around p are nearer than p's own, level with it, or
    farther, with a transition of 1 px of radius. Nearer ones take the part of p's aperture that
    their discs cover. From the rest, p's own surface takes a share: the area of its disc where it
    is present, over the area that nothing nearer hides. Inside the edge of an out-of-focus object,
    light from farther surfaces passes by. The render hides that area, so the nearest of the farther
    surfaces replace it.

    The layers around a pixel follow Jimenez ("Next generation post processing in Call of Duty",
    SIGGRAPH 2014). The hidden part follows Kraus and Strengert ("Depth-of-field rendering by
    pyramidal image processing", Eurographics 2007).

    Args:
        image: (height, width, 3).
        radii: radii of the discs in px, (height, width); negative if nearer than the focus
            distance.
        taps: see :func:`aperture_taps`.
    """
    zero, one, half = np.float32(0), np.float32(1), np.float32(0.5)
    centre, size = radii, abs(radii)
    area = _area(size)
    # Sums for surfaces that are nearer than, level with and farther than the pixel's surface.
    light: Floats = np.zeros((3, *image.shape), np.float32)
    total: Floats = np.zeros((3, *radii.shape), np.float32)
    free: Floats = np.zeros(radii.shape, np.float32)
    for dx, dy, edge, hidden in taps:
        neighbour = tap(radii, int(dx), int(dy))
        disc = abs(neighbour)
        weight = np.clip(disc + (half - edge), zero, one) / _area(disc)
        nearer, farther = (
            np.clip(centre - neighbour, zero, one),
            np.clip(neighbour - centre, zero, one),
        )
        level = one - nearer - farther
        shares = np.stack([nearer * weight, level * weight, farther * (weight + hidden)])
        light += shares[..., None] * tap(image, int(dx), int(dy))
        total += shares
        free += (one - nearer) * (np.clip(size + (half - edge), zero, one) / area)
    in_front, level, behind = total
    remaining = one - np.minimum(in_front, one)
    covered = np.where(behind > 0, remaining * np.minimum(level / free, one), remaining)
    of_behind = (remaining - covered) / np.where(behind > 0, behind, one)
    shares = np.stack([one / np.maximum(in_front, one), covered / level, of_behind])
    return np.asarray((light * shares[..., None]).sum(0))


def _area(radius: Floats) -> Floats:
    """Return the area of a disc with a soft edge, in px."""
    whole = np.float32(np.pi) * (radius * radius) + np.float32(np.pi / 12)
    return np.asarray(np.maximum(radius + np.float32(0.5), whole))
