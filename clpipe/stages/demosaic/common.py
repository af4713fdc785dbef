"""Functions that demosaicing methods share, like the functions of ``kernels/lib/demosaic.h``.

Mosaics and planes are (height, width) in signal units; borders are mirrored.
"""

import numpy as np

from clpipe.base.types import Floats
from clpipe.reference.cfa import Pattern, by_site, red_site
from clpipe.reference.image import tap

HALF, QUARTER, EIGHTH = np.float32(0.5), np.float32(0.25), np.float32(0.125)


def mean_left_right(image: Floats) -> Floats:
    """Return the mean of the pixels to the left and right of each pixel.

    >>> mean_left_right(np.float32([[1, 2, 5]])).tolist()
    [[2.0, 3.0, 2.0]]
    """
    return (tap(image, -1, 0) + tap(image, 1, 0)) * HALF


def mean_above_below(image: Floats) -> Floats:
    """Return the mean of the pixels above and below each pixel."""
    return (tap(image, 0, -1) + tap(image, 0, 1)) * HALF


def sum_of_corners(image: Floats) -> Floats:
    """Return the sum of the four diagonal neighbours of each pixel."""
    upper, lower = (tap(image, -1, dy) + tap(image, 1, dy) for dy in (-1, 1))
    return upper + lower


def red_and_blue(
    pattern: Pattern, at_site: Floats, in_row: Floats, in_column: Floats, across: Floats
) -> tuple[Floats, Floats]:
    """Return red and blue at every pixel, (height, width) each, chosen from four images by site.

    Args:
        pattern: the CFA pattern.
        at_site: at red and blue sites, the value for the site's own colour.
        in_row: at green sites, the value for the colour (red or blue) whose sites are in that row.
        in_column: at green sites, the value for the colour whose sites are in that column.
        across: at red sites the value for blue, at blue sites the value for red.

    >>> values = [np.full((2, 2), v, np.float32) for v in (0, 1, 2, 3)]
    >>> [colour.tolist() for colour in red_and_blue("RGGB", *values)]
    [[[0.0, 1.0], [2.0, 3.0]], [[3.0, 2.0], [1.0, 0.0]]]
    """
    red_row = (np.arange(at_site.shape[0])[:, None] & 1) == red_site(pattern)[1]
    red_at_green = np.where(red_row, in_row, in_column)
    blue_at_green = np.where(red_row, in_column, in_row)
    return (
        by_site(at_site.shape, pattern, at_site, red_at_green, across),
        by_site(at_site.shape, pattern, across, blue_at_green, at_site),
    )


def spread_differences(sparse: Floats, pattern: Pattern) -> tuple[Floats, Floats]:
    """Return R-G and B-G at every pixel, (height, width) each, by bilinear interpolation.

    ``sparse`` is (height, width) and holds R-G at red sites and B-G at blue sites.
    """
    across = sum_of_corners(sparse) * QUARTER
    return red_and_blue(pattern, sparse, mean_left_right(sparse), mean_above_below(sparse), across)


def from_differences(
    samples: Floats, pattern: Pattern, red_difference: Floats, blue_difference: Floats
) -> Floats:
    """Return RGB, (height, width, 3), from the sensor's samples, R-G and B-G.

    The samples do not change; the missing colours are samples plus or minus the differences.

    >>> samples, one = np.float32([[5, 3], [3, 2]]), np.ones((2, 2), np.float32)
    >>> from_differences(samples, "RGGB", one, -one)[0].tolist()
    [[5.0, 4.0, 3.0], [4.0, 3.0, 2.0]]
    """
    shape = samples.shape
    green = by_site(shape, pattern, samples - red_difference, samples, samples - blue_difference)
    red, blue = green + red_difference, green + blue_difference
    red = by_site(shape, pattern, samples, red, red)
    blue = by_site(shape, pattern, blue, blue, samples)
    return np.stack([red, green, blue], axis=-1)
