"""Demosaicing within bounds from the surrounding samples."""

from typing import ClassVar, Self

import numpy as np

from clpipe.base.types import Floats
from clpipe.reference.cfa import Pattern, by_site
from clpipe.reference.image import tap
from clpipe.reference.roots import from_root, in_steps, noise_in_roots, root_of
from clpipe.stage import (
    Arguments,
    Context,
    Kind,
    Method,
    Pass,
    ReferenceContext,
    Stencil,
    parameter,
)
from clpipe.stages.demosaic.common import (
    QUARTER,
    from_differences,
    mean_above_below,
    mean_left_right,
    red_and_blue,
    spread_differences,
)
from clpipe.stages.denoise.strength import (
    MID_GREY,
    noise_of_colours,
    offset_of_roots,
    offset_parameter,
)

# Roots of the signal; the directions count as alike if the gradient is below this value. We chose a
# hundredth of white: it is less than the noise of most images, and no edge is so weak.
EQUAL_GRADIENT = np.float32(0.01**2)


def clamp_to_range(values: Floats, *neighbours: Floats) -> Floats:
    """Limit values to the range of their neighbours; all arrays have one shape.

    >>> clamp_to_range(np.float32([0, 5, 9]), np.float32([1, 1, 1]), np.float32([6, 6, 6])).tolist()
    [1.0, 5.0, 6.0]
    """
    return np.clip(values, np.minimum.reduce(neighbours), np.maximum.reduce(neighbours))


def green_or_difference(roots: Floats, pattern: Pattern) -> Floats:
    """Return R-G at red sites, B-G at blue sites and 0 at green ones, (height, width), in roots.

    At red and blue sites, green is interpolated along the row and along the column after Hamilton
    and Adams (US patent 5,629,734, 1997). Both values are limited to the range of their two
    neighbours. The result is their mean, each weighted by the squared gradient of the other. A
    choice of one direction would flip from pixel to pixel where noise decides.
    """
    neighbours = {step: tap(roots, *step) for step in ((-1, 0), (1, 0), (0, -1), (0, 1))}
    west, east, north, south = neighbours.values()
    bend_x = np.float32(2) * roots - tap(roots, -2, 0) - tap(roots, 2, 0)
    bend_y = np.float32(2) * roots - tap(roots, 0, -2) - tap(roots, 0, 2)
    green_x = clamp_to_range(mean_left_right(roots) + bend_x * QUARTER, west, east)
    green_y = clamp_to_range(mean_above_below(roots) + bend_y * QUARTER, north, south)
    weight_y = np.square(abs(west - east) + abs(bend_x)) + EQUAL_GRADIENT
    weight_x = np.square(abs(north - south) + abs(bend_y)) + EQUAL_GRADIENT
    green = (green_x * weight_x + green_y * weight_y) / (weight_x + weight_y)
    return by_site(roots.shape, pattern, roots - green, np.float32(0), roots - green)


NEIGHBOURS = (
    ((-1, 0), (1, 0)),  # in the row
    ((0, -1), (0, 1)),  # in the column
    ((-1, -1), (1, -1), (-1, 1), (1, 1)),  # at the corners
)


def bounds(
    roots: Floats, differences: Floats, green: Floats, pattern: Pattern, noise_margin: np.float32
) -> tuple[tuple[Floats, Floats], tuple[Floats, Floats]]:
    """Return the limits of red and blue, (red, blue) each, (height, width), in roots.

    The limits are those of the nearest samples of that colour, widened by the amount, minus
    ``noise_margin``, by which green exceeds its own values at those samples. A line narrower than
    the pattern is an extreme of green, and red and blue must follow it. At the edge of a colour,
    green only rises or falls, and red and blue must not overshoot.

    Args:
        roots: the samples.
        differences: :func:`green_or_difference` of them.
        green: green at every pixel.
        pattern: the CFA pattern.
        noise_margin: the change of green that noise alone may cause.
    """
    green_at_sites = roots - differences  # green at red and blue sites
    low, high = [], []
    for steps in NEIGHBOURS:
        samples = [tap(roots, *step) for step in steps]
        greens = [tap(green_at_sites, *step) for step in steps]
        below = np.minimum(green - np.minimum.reduce(greens) + noise_margin, np.float32(0))
        above = np.maximum(green - np.maximum.reduce(greens) - noise_margin, np.float32(0))
        low.append(np.minimum.reduce(samples) + below)
        high.append(np.maximum.reduce(samples) + above)
    return red_and_blue(pattern, roots, *low), red_and_blue(pattern, roots, *high)


class Bounded(Method):
    """Edge-directed, on roots of the signal, within bounds from the surrounding samples.

    Green follows edges (Hamilton and Adams, US patent 5,629,734, 1997) with a soft decision. It
    stays between its two neighbours, like in AHD (Hirakawa and Parks, IEEE TIP 2005) and PPG. Red
    and blue follow from bilinear colour differences. They stay between their neighbours wherever
    green does. In linear light and without bounds, colour differences create false colours at the
    edges of saturated surfaces. They also carry the noise of a bright colour into the dark ones.
    """

    method: ClassVar = "bounded"
    kernel: ClassVar = "demosaic_bounded"
    summary: ClassVar = "edge-directed, within bounds from the surrounding samples"
    tolerance: ClassVar = 5e-5  # the kernel's root is a short iteration

    noise: float | None = parameter(
        None,
        "Standard deviation of green's noise at mid grey.",
        "signal",
        "from the a and b of sensor_noise",
        ge=0,
    )
    offset: float | None = offset_parameter()

    def resolve(self, context: Context) -> Self:
        _, green, _ = noise_of_colours(context)
        return self.with_defaults(
            noise=np.sqrt(green.at(MID_GREY)), offset=offset_of_roots(context)
        )

    @property
    def noise_margin(self) -> float:
        """The noise that green may have, in roots: three sigma plus an invisible difference."""
        assert self.noise is not None and self.offset is not None
        return 0.01 + 3 * noise_in_roots(self.noise, MID_GREY, self.offset)

    def passes(self) -> tuple[Pass, ...]:
        return (
            Pass("to_roots", arguments=("offset",), writes="roots", kind=Kind.MOSAIC),
            Pass(
                "bounded_green",
                Stencil(2),
                ("pattern", "even"),
                reads=("roots",),
                writes="known",
                kind=Kind.MOSAIC,
            ),
            Pass(
                "bounded_red_and_blue",
                Stencil(1),
                ("pattern", "noise"),
                reads=("roots", "known"),
                writes="colours",
            ),
            Pass("roots_to_light", arguments=("offset",), reads=("colours",)),
        )

    def arguments(self, context: Context) -> Arguments:
        known = super().arguments(context)
        return {**known, "even": EQUAL_GRADIENT, "noise": self.noise_margin}

    def reference(self, image: Floats, inputs: ReferenceContext) -> Floats:
        pattern, offset = inputs.context.pattern, np.float32(self.offset)
        roots = root_of(image, offset)
        known = green_or_difference(roots, pattern)
        differences = spread_differences(known, pattern)
        red, green, blue = np.moveaxis(from_differences(roots, pattern, *differences), -1, 0)
        (red_low, blue_low), (red_high, blue_high) = bounds(
            roots, known, green, pattern, np.float32(self.noise_margin)
        )
        red, blue = np.clip(red, red_low, red_high), np.clip(blue, blue_low, blue_high)
        return from_root(in_steps(np.stack([red, green, blue], axis=-1)), offset)
