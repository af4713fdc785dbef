"""Edge-directed demosaicing: green is interpolated along edges, not across them."""

import typing
from typing import ClassVar

import numpy as np

from clpipe.base.types import Floats
from clpipe.reference.cfa import Pattern, by_site
from clpipe.reference.image import tap
from clpipe.stage import Kind, Method, Pass, ReferenceContext, Stencil, parameter
from clpipe.stages.demosaic.common import (
    HALF,
    QUARTER,
    from_differences,
    mean_above_below,
    mean_left_right,
    spread_differences,
)

Classifier = typing.Literal["hamilton_adams", "laroche_prescott", "hibbard"]


def green_or_difference(image: Floats, pattern: Pattern, classifier: Classifier) -> Floats:
    """Return R-G at red sites, B-G at blue sites and 0 at green ones, (height, width).

    At red and blue sites, green is the mean of its two neighbours in the direction with the smaller
    gradient, or of all four if the gradients are equal. The classifier defines the gradient in a
    direction:

    - ``hibbard`` (US patent 5,382,976, 1995): the absolute difference of the two green neighbours;
    - ``laroche_prescott`` (US patent 5,373,322, 1994): the absolute second derivative of the site's
      own colour, from the site and the samples 2 px to both sides;
    - ``hamilton_adams`` (US patent 5,629,734, 1997): the sum of both; a quarter of the second
      derivative, with its sign, is then added to the mean.

    >>> edge = np.repeat(np.float32([[0, 0, 0, 8, 8, 8]]), 6, axis=0)
    >>> green_or_difference(edge, "RGGB", "hibbard")[2].tolist()
    [0.0, 0.0, 0.0, 0.0, 0.0, 0.0]
    """
    change_x = abs(tap(image, -1, 0) - tap(image, 1, 0))
    change_y = abs(tap(image, 0, -1) - tap(image, 0, 1))
    bend_x = np.float32(2) * image - tap(image, -2, 0) - tap(image, 2, 0)
    bend_y = np.float32(2) * image - tap(image, 0, -2) - tap(image, 0, 2)
    green_x, green_y = mean_left_right(image), mean_above_below(image)
    match classifier:
        case "hibbard":
            gradient_x, gradient_y = change_x, change_y
        case "laroche_prescott":
            gradient_x, gradient_y = abs(bend_x), abs(bend_y)
        case "hamilton_adams":
            gradient_x, gradient_y = change_x + abs(bend_x), change_y + abs(bend_y)
            green_x, green_y = green_x + bend_x * QUARTER, green_y + bend_y * QUARTER
    either = (green_x + green_y) * HALF
    not_x = np.where(gradient_y < gradient_x, green_y, either)
    green = np.where(gradient_x < gradient_y, green_x, not_x)
    return by_site(image.shape, pattern, image - green, np.float32(0), image - green)


class EdgeDirected(Method):
    """Green along edges; red and blue from bilinearly interpolated R-G and B-G.

    The classifiers: Hamilton and Adams (US patent 5,629,734, 1997), Laroche and Prescott
    (US patent 5,373,322, 1994), Hibbard (US patent 5,382,976, 1995).
    """

    method: ClassVar = "edge_directed"
    kernel: ClassVar = "demosaic_edge_directed"
    summary: ClassVar = "green along edges, then bilinear colour differences"

    classifier: Classifier = parameter(
        "hamilton_adams",
        "Gradient that decides the direction of an edge, named after the authors of its patent.",
        structural=True,
    )

    def passes(self) -> tuple[Pass, ...]:
        return (
            Pass(
                "green_or_difference",
                Stencil(2),
                ("pattern", "classifier"),
                writes="known",
                kind=Kind.MOSAIC,
            ),
            Pass("add_differences", Stencil(1), ("pattern",), reads=("src", "known")),
        )

    def reference(self, image: Floats, inputs: ReferenceContext) -> Floats:
        pattern = inputs.context.pattern
        sparse = green_or_difference(image, pattern, self.classifier)
        return from_differences(image, pattern, *spread_differences(sparse, pattern))
