"""Demosaicing whose samples stay between their neighbours."""

from collections.abc import Mapping
from typing import ClassVar

import numpy as np

from clpipe.base.types import Floats
from clpipe.reference.cfa import Pattern, by_site
from clpipe.reference.image import tap
from clpipe.reference.roots import from_root, root_of
from clpipe.stage import Access, Argument, Context, Frame, Kind, Method, Pass
from clpipe.stages.demosaic.common import (
    QUARTER,
    from_differences,
    mean_above_below,
    mean_beside,
    red_and_blue,
    spread_differences,
)

# The gradient, in roots of the signal, below which both directions are alike. Chosen: a hundredth
# of white is less than the noise of most pictures, and no edge.
EVEN = np.float32(0.01**2)

# Of the roots, in signal units. Chosen: at 0.005 to 0.04 the PSNR of a noise-free picture is the
# same within 0.2 dB.
OFFSET = np.float32(0.03)


def between(values: Floats, *neighbours: Floats) -> Floats:
    """Values, none below the least or above the greatest of its neighbours; all of one shape.

    >>> between(np.float32([0, 5, 9]), np.float32([1, 1, 1]), np.float32([6, 6, 6])).tolist()
    [1.0, 5.0, 6.0]
    """
    return np.clip(values, np.minimum.reduce(neighbours), np.maximum.reduce(neighbours))


def green_or_difference(roots: Floats, pattern: Pattern) -> Floats:
    """Green at green sites, R-G at red sites and B-G at blue sites, (height, width), in roots.

    At red and blue sites green is interpolated along the row and along the column as Hamilton and
    Adams do (US patent 5,629,734, 1997), and kept between its two neighbours. Both are averaged,
    each weighted by the squared gradient of the other: where noise decides between the directions,
    a choice of one would flip from pixel to pixel.
    """
    neighbours = {step: tap(roots, *step) for step in ((-1, 0), (1, 0), (0, -1), (0, 1))}
    west, east, north, south = neighbours.values()
    bend_x = np.float32(2) * roots - tap(roots, -2, 0) - tap(roots, 2, 0)
    bend_y = np.float32(2) * roots - tap(roots, 0, -2) - tap(roots, 0, 2)
    green_x = between(mean_beside(roots) + bend_x * QUARTER, west, east)
    green_y = between(mean_above_below(roots) + bend_y * QUARTER, north, south)
    weight_y = np.square(abs(west - east) + abs(bend_x)) + EVEN
    weight_x = np.square(abs(north - south) + abs(bend_y)) + EVEN
    green = (green_x * weight_x + green_y * weight_y) / (weight_x + weight_y)
    return by_site(roots.shape, pattern, roots - green, roots, roots - green)


class Bounded(Method):
    """Edge-directed, on roots of the signal, with every missing sample between its neighbours.

    Green follows edges (Hamilton and Adams, US patent 5,629,734, 1997), softly. Red and blue follow
    from bilinear colour differences. A missing sample is never below the least or above the
    greatest of its nearest neighbours of that colour, as in AHD (Hirakawa and Parks, IEEE TIP 2005)
    and PPG. In linear light, colour differences invent colours at the edges of saturated surfaces,
    and pass the noise of a bright colour on to the dark ones beside it.
    """

    method: ClassVar = "bounded"
    kernel: ClassVar = "demosaic_bounded"
    summary: ClassVar = "edge-directed; no missing sample is beyond its neighbours"
    tolerance: ClassVar = 5e-5  # the kernel's root is a short iteration

    def passes(self) -> tuple[Pass, ...]:
        return (
            Pass("to_roots", arguments=("offset",), writes="roots", kind=Kind.MOSAIC),
            Pass(
                "bounded_green",
                Access.STENCIL,
                ("pattern", "even"),
                reads=("roots",),
                writes="known",
                kind=Kind.MOSAIC,
                radius=2,
            ),
            Pass(
                "bounded_red_and_blue",
                Access.STENCIL,
                ("pattern", "offset"),
                reads=("roots", "known"),
                radius=1,
            ),
        )

    def arguments(self, context: Context) -> Mapping[str, Argument]:
        return {"pattern": context.cfa, "even": EVEN, "offset": OFFSET}

    def reference(self, image: Floats, frame: Frame) -> Floats:
        pattern, roots = frame.context.pattern, root_of(image, OFFSET)
        differences = spread_differences(green_or_difference(roots, pattern), pattern)
        red, green, blue = np.moveaxis(from_differences(roots, pattern, *differences), -1, 0)
        corners = [tap(roots, dx, dy) for dx in (-1, 1) for dy in (-1, 1)]
        beside = [tap(roots, -1, 0), tap(roots, 1, 0)]
        above_below = [tap(roots, 0, -1), tap(roots, 0, 1)]

        def bound(reduce: np.ufunc) -> tuple[Floats, Floats]:
            sets = (beside, above_below, corners)
            return red_and_blue(pattern, roots, *(reduce.reduce(taps) for taps in sets))

        low, high = bound(np.minimum), bound(np.maximum)
        red, blue = np.clip(red, low[0], high[0]), np.clip(blue, low[1], high[1])
        return from_root(np.stack([red, green, blue], axis=-1), OFFSET)
