"""Menon, Andriani and Calvagno's demosaicing with a posteriori decision.

D. Menon, S. Andriani, G. Calvagno: "Demosaicing with directional filtering and a posteriori
decision", IEEE Transactions on Image Processing 16(1), 2007. Below, "own" is the colour of a red or
blue site. "Other" is blue at a red site and red at a blue site.
"""

from typing import ClassVar

import numpy as np

from clpipe.base.types import Floats, Mask
from clpipe.reference.cfa import Pattern, by_site
from clpipe.reference.image import tap
from clpipe.stage import Kind, Method, Pass, ReferenceContext, Stencil
from clpipe.stages.demosaic.common import (
    HALF,
    QUARTER,
    mean_above_below,
    mean_left_right,
    red_and_blue,
)

THIRD = np.float32(1 / 3)


def directional_differences(image: Floats, pattern: Pattern) -> tuple[Floats, Floats]:
    """Return own minus green, with green interpolated along the row and along the column.

    Two (height, width) images, 0 at green sites. ``hamilton_adams`` interpolates green.

    >>> ramp = np.tile(np.arange(8, dtype=np.float32) ** 2, (8, 1))
    >>> [abs(d[:, 2:6]).max().item() for d in directional_differences(ramp, "RGGB")]
    [1.0, 0.0]
    """
    bend_x = np.float32(2) * image - tap(image, -2, 0) - tap(image, 2, 0)
    bend_y = np.float32(2) * image - tap(image, 0, -2) - tap(image, 0, 2)
    in_row = image - (mean_left_right(image) + bend_x * QUARTER)
    in_column = image - (mean_above_below(image) + bend_y * QUARTER)
    zero = np.float32(0)
    return (
        by_site(image.shape, pattern, in_row, zero, in_row),
        by_site(image.shape, pattern, in_column, zero, in_column),
    )


def change(differences: Floats) -> Floats:
    """Return the change of horizontal differences around each red or blue site, (height, width).

    The sum of absolute changes between adjacent samples of one colour, 2 px apart, in the five rows
    of a 5x5 window. The middle row counts three times.
    """
    own = abs(tap(differences, -2, 0) - differences) + abs(differences - tap(differences, 2, 0))
    other = abs(tap(differences, -1, 0) - tap(differences, 1, 0))
    near = tap(other, 0, -1) + tap(other, 0, 1)
    far = tap(own, 0, -2) + tap(own, 0, 2)
    return np.float32(3) * own + near + far


def neighbour_differences(
    sparse: Floats, in_row: Mask
) -> tuple[tuple[Floats, Floats], tuple[Floats, Floats]]:
    """Return the differences at the two green neighbours, in the chosen direction of each site.

    Args:
        sparse: (height, width), own minus green at red and blue sites, 0 at green sites.
        in_row: (height, width), True where the chosen direction is the row.

    Returns:
        Own minus green and own minus other, each for the left or upper and for the right or lower
        neighbour. The difference at a green site is the mean of those at its two adjacent sites.
    """
    left_right, above_below = mean_left_right(sparse), mean_above_below(sparse)
    own_green, own_other = [], []
    for step in (-1, 1):
        own = np.where(in_row, tap(left_right, step, 0), tap(above_below, 0, step))
        other = np.where(in_row, tap(above_below, step, 0), tap(left_right, 0, step))
        own_green.append(own)
        own_other.append(own - other)
    return (own_green[0], own_green[1]), (own_other[0], own_other[1])


def menon2007(image: Floats, pattern: Pattern) -> Floats:
    """Return RGB, (height, width, 3), from a mosaic, with the paper's refinement step.

    >>> edge = np.repeat(np.float32([0.2, 0.7]), 5)[None].repeat(10, axis=0)
    >>> bool(np.allclose(menon2007(edge, "BGGR"), edge[..., None]))
    True
    """
    # Interpolate green in both directions, and choose the one in which colour differences change
    # less.
    by_row, by_column = directional_differences(image, pattern)
    in_row = change(by_row) <= change(by_column.T).T
    selected = np.where(in_row, by_row, by_column)
    # First estimate of the difference between the site's own colour and the other one (R-B or B-R).
    # It is refined below.
    (left, right), (left_other, right_other) = neighbour_differences(selected, in_row)
    own_other = (left_other + right_other) * HALF
    # Refine green: own minus green becomes the mean of three values along the direction.
    refined = (left + selected + right) * THIRD
    refined = by_site(image.shape, pattern, refined, selected, refined)
    green = image - refined
    # Refine the other colour in the same way. At green sites, red and blue are interpolated
    # bilinearly.
    _, (left_other, right_other) = neighbour_differences(refined, in_row)
    other = image - (left_other + own_other + right_other) * THIRD
    red, blue = red_and_blue(
        pattern, image, image + mean_left_right(refined), image + mean_above_below(refined), other
    )
    return np.stack([red, green, blue], axis=-1)


class Menon2007(Method):
    """Directional filtering with a posteriori decision and refinement (Menon et al., TIP 2007)."""

    method: ClassVar = "menon2007"
    kernel: ClassVar = "demosaic_menon2007"
    summary: ClassVar = (
        "green in both directions, then choice of the better one and refinement (Menon et al.)"
    )

    def passes(self) -> tuple[Pass, ...]:
        names = ("pattern",)
        return (
            Pass("directional_differences", Stencil(2), names, writes="both", kind=Kind.PAIR),
            Pass("decide", Stencil(2), reads=("both",), writes="chosen", kind=Kind.PAIR),
            Pass("refine", Stencil(2), names, ("chosen",), writes="refined", kind=Kind.PAIR),
            Pass("interpolate", Stencil(2), names, ("src", "chosen", "refined")),
        )

    def reference(self, image: Floats, inputs: ReferenceContext) -> Floats:
        return menon2007(image, inputs.context.pattern)
