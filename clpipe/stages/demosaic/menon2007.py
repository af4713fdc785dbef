"""Menon, Andriani and Calvagno's demosaicing with a posteriori decision.

D. Menon, S. Andriani, G. Calvagno: "Demosaicing with directional filtering and a posteriori
decision", IEEE Transactions on Image Processing 16(1), 2007. In what follows, at a red or blue
site "own" is the site's colour and "other" is blue or red.
"""

from collections.abc import Mapping
from typing import ClassVar

import numpy as np

from clpipe.base.types import Array, Floats
from clpipe.reference.cfa import Pattern, by_site
from clpipe.reference.image import tap
from clpipe.stage import Access, Argument, Context, Frame, Kind, Method, Pass
from clpipe.stages.demosaic.common import HALF, QUARTER, mean_above_below, mean_beside, red_and_blue

THIRD = np.float32(1 / 3)


def directional_differences(image: Floats, pattern: Pattern) -> tuple[Floats, Floats]:
    """Own minus green, green interpolated along the row and along the column; 0 at green sites.

    >>> ramp = np.tile(np.arange(8, dtype=np.float32) ** 2, (8, 1))
    >>> [abs(d[:, 2:6]).max().item() for d in directional_differences(ramp, "RGGB")]
    [1.0, 0.0]
    """
    bend_x = np.float32(2) * image - tap(image, -2, 0) - tap(image, 2, 0)
    bend_y = np.float32(2) * image - tap(image, 0, -2) - tap(image, 0, 2)
    in_row = image - (mean_beside(image) + bend_x * QUARTER)
    in_column = image - (mean_above_below(image) + bend_y * QUARTER)
    zero = np.float32(0)
    return (
        by_site(image.shape, pattern, in_row, zero, in_row),
        by_site(image.shape, pattern, in_column, zero, in_column),
    )


def change(differences: Floats) -> Floats:
    """How much horizontal differences change around a red or blue site.

    The sum of absolute changes between next neighbours in the rows of a 5x5 window, those of the
    middle row three times.
    """
    own = abs(tap(differences, -2, 0) - differences) + abs(differences - tap(differences, 2, 0))
    other = abs(tap(differences, -1, 0) - tap(differences, 1, 0))
    near = tap(other, 0, -1) + tap(other, 0, 1)
    far = tap(own, 0, -2) + tap(own, 0, 2)
    return np.float32(3) * own + near + far


def along(known: Floats, row_won: Array) -> tuple[tuple[Floats, Floats], tuple[Floats, Floats]]:
    """The two green sites beside each red or blue one, in the direction that won there.

    ``known`` holds own minus green at red and blue sites, green at the others. Returns own minus
    green and own minus other, each for the left or upper and for the right or lower neighbour; a
    difference that is not known at a green site is the mean of the two that are known beside it.
    """
    beside, above_below = mean_beside(known), mean_above_below(known)
    own_green, own_other = [], []
    for step in (-1, 1):
        own = np.where(row_won, tap(beside, step, 0), tap(above_below, 0, step))
        other = np.where(row_won, tap(above_below, step, 0), tap(beside, 0, step))
        own_green.append(own)
        own_other.append(own - other)
    return (own_green[0], own_green[1]), (own_other[0], own_other[1])


def menon2007(image: Floats, pattern: Pattern) -> Floats:
    """RGB, (height, width, 3), from a mosaic, with the refining step.

    >>> edge = np.repeat(np.float32([0.2, 0.7]), 5)[None].repeat(10, axis=0)
    >>> bool(np.allclose(menon2007(edge, "BGGR"), edge[..., None]))
    True
    """
    # Directional green, and the decision: the direction in which colour differences change less.
    in_row, in_column = directional_differences(image, pattern)
    row_won = change(in_row) <= change(in_column.T).T
    chosen = np.where(row_won, in_row, in_column)
    chosen = by_site(image.shape, pattern, chosen, image, chosen)
    # Own minus other from what is known now; it is refined after green.
    (left, right), (left_other, right_other) = along(chosen, row_won)
    own_other = (left_other + right_other) * HALF
    # Refining green: own minus green becomes the mean of three along the direction.
    refined = (left + chosen + right) * THIRD
    refined = by_site(image.shape, pattern, refined, image, refined)
    green = by_site(image.shape, pattern, image - refined, image, image - refined)
    # Refining the other colour likewise; red and blue at green sites are bilinear.
    _, (left_other, right_other) = along(refined, row_won)
    other = image - (left_other + own_other + right_other) * THIRD
    red, blue = red_and_blue(
        pattern, image, image + mean_beside(refined), image + mean_above_below(refined), other
    )
    return np.stack([red, green, blue], axis=-1)


class Menon2007(Method):
    """Directional filtering and a posteriori decision, refined (Menon et al., TIP 2007)."""

    method: ClassVar = "menon2007"
    kernel: ClassVar = "demosaic_menon2007"
    summary: ClassVar = "directional green, chosen afterwards, and refined (Menon et al.)"

    def passes(self) -> tuple[Pass, ...]:
        def stencil(function: str, radius: int, *reads: str, writes: str = "dst") -> Pass:
            kind = None if writes == "dst" else Kind.PAIR
            return Pass(function, Access.STENCIL, ("pattern",), reads, writes, kind, radius)

        return (
            stencil("directional_differences", 2, "src", writes="both"),
            stencil("decide", 2, "src", "both", writes="chosen"),
            stencil("refine", 2, "chosen", writes="refined"),
            stencil("interpolate", 2, "src", "chosen", "refined"),
        )

    def arguments(self, context: Context) -> Mapping[str, Argument]:
        return {"pattern": context.cfa}

    def reference(self, image: Floats, frame: Frame) -> Floats:
        return menon2007(image, frame.context.pattern)
