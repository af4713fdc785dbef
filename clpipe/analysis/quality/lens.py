"""Figures of lenses: distortion and lateral colour of dots, shading of a flat field, and glare."""

import numpy as np

from clpipe.analysis.quality.grids import numbered
from clpipe.base.types import Doubles

DARK = 0.6  # of the local white, below which a pixel belongs to a dot
MIN_DOTS, MOST_DOTS = 25, 20_000
SMALLEST = 20  # px, of the area of a dot
ROUND = 0.12  # largest difference of a dot's area over that of its box from that of a circle
IN_GRID = 0.7  # least share of the dots that form the grid
BLOCKS = 16  # of a flat field along its longer side


def dot_grid(light: Doubles) -> tuple[Doubles, Doubles] | None:
    """Return the dots of a picture, or None if there is no grid of dots.

    The first array has the row and column of each dot from the central one, (dot, 2). The second
    has the centres of its red, green and blue, (dot, 3, 2): y and x, px from the middle.

    Args:
        light: linear RGB, (height, width, 3), of dark dots on white.
    """
    from scipy import ndimage

    green = light[..., 1]
    step = max(4, max(green.shape) // 400)
    white = ndimage.percentile_filter(green[::step, ::step], 90, 25).repeat(step, 0).repeat(step, 1)
    labels, _ = ndimage.label(green < DARK * white[: green.shape[0], : green.shape[1]])
    areas = np.bincount(labels.ravel())[1:]
    if not MIN_DOTS <= (areas >= SMALLEST).sum() < MOST_DOTS:
        return None
    boxes = [
        box
        for box, area in zip(ndimage.find_objects(labels), areas, strict=True)
        if area >= SMALLEST
    ]
    areas = areas[areas >= SMALLEST]
    starts, stops = (
        np.array([[getattr(s, end) for s in b] for b in boxes]) for end in ("start", "stop")
    )
    sizes = stops - starts
    usual = np.median(sizes, axis=0)
    margin = int(usual.max() / 2) + 2
    whole = np.abs(sizes - usual) <= 0.35 * usual + 1
    whole &= (np.abs(areas / sizes.prod(1) - np.pi / 4) < ROUND)[:, None]
    inside = (starts >= margin) & (stops + margin <= green.shape)
    found = [
        np.add(
            _centroids(light[y - margin : y + high + margin, x - margin : x + wide + margin]),
            (y, x),
        )
        for (y, x), (high, wide), good in zip(starts, sizes, whole & inside, strict=True)
        if good.all()
    ]
    if len(found) < MIN_DOTS:
        return None
    points = np.array(found) - margin - (np.array(green.shape) - 1) / 2
    grid = numbered(points[:, 1], max(MIN_DOTS, round(IN_GRID * len(points))))
    return (grid[0], points[grid[1]]) if grid else None


def _centroids(light: Doubles) -> Doubles:
    """Return the centroids of a dark dot in red, green and blue, (3, 2): y, x.

    White is a plane through the border of the window, because light may fall off.
    """
    y, x = np.mgrid[: light.shape[0], : light.shape[1]]
    border = np.ones(light.shape[:2], bool)
    border[2:-2, 2:-2] = False
    terms = np.stack([np.ones_like(y), y, x], axis=-1)
    plane, *_ = np.linalg.lstsq(terms[border], light[border], rcond=None)
    dark = terms @ plane - light
    at = [(dark * axis[..., None]).sum((0, 1)) / dark.sum((0, 1)) for axis in (y, x)]
    return np.stack(at, axis=-1)


def dot_figures(numbers: Doubles, places: Doubles) -> dict[str, float]:
    """Return distortion and lateral colour of a grid of dots.

    ``distortion`` is the local geometric distortion (ISO 17850:2015) of the dot farthest from the
    centre, in % of its distance from there; ``most_distortion`` the largest of all in size. The
    undistorted grid is that of the central 25 dots. ``lateral_red`` and ``lateral_blue`` tell how
    far red and blue are outside of green in the outermost tenth of the dots, px (ISO 19084:2015).

    Args:
        numbers: rows and columns from :func:`dot_grid`.
        places: centres from there.
    """
    green = places[:, 1]
    inner = np.abs(numbers).max(1) <= 2
    terms = np.column_stack([np.ones(len(numbers)), numbers])
    affine, *_ = np.linalg.lstsq(terms[inner], green[inner], rcond=None)
    ideal = terms @ affine
    radius = np.hypot(*ideal.T)
    far = radius > 2 * np.hypot(*affine[1])
    error = 100 * (np.hypot(*green[far].T) / radius[far] - 1)
    outer = np.hypot(*green.T) >= np.percentile(np.hypot(*green.T), 90)
    outwards = green[outer] / np.hypot(*green[outer].T)[:, None]
    shift = ((places[outer] - green[outer, None]) * outwards[:, None]).sum(-1).mean(0)
    return {
        "distortion": float(error[radius[far].argmax()]),
        "most_distortion": float(error[np.abs(error).argmax()]),
        "lateral_red": float(shift[0]),
        "lateral_blue": float(shift[2]),
    }


def shading(light: Doubles) -> dict[str, float]:
    """Return the shading of a flat field: light in the corners over that in the centre, in %.

    ``shading`` is the mean of the four corners, ``darkest_corner`` the lowest. ``color_shading`` is
    the largest difference of red or blue over green there, in %.

    >>> shading(np.ones((64, 96, 3)))
    {'shading': 100.0, 'darkest_corner': 100.0, 'color_shading': 0.0}

    Args:
        light: linear RGB, (height, width, 3).
    """
    side = max(light.shape[0] // 8, light.shape[1] // BLOCKS, 1)
    top, left = ((n - side) // 2 for n in light.shape[:2])
    centre = light[top : top + side, left : left + side].mean((0, 1))
    ends = np.s_[:side], np.s_[-side:]
    ratios = np.array([light[y, x].mean((0, 1)) / centre for y in ends for x in ends])
    colour = ratios[:, [0, 2]] / ratios[:, [1]] - 1
    return {
        "shading": float(100 * ratios[:, 1].mean()),
        "darkest_corner": float(100 * ratios[:, 1].min()),
        "color_shading": float(100 * np.abs(colour).max()),
    }


def glare(light: Doubles) -> float:
    """Return the light in the centre of a black spot over that around it, in % (ISO 18844:2017).

    Args:
        light: linear RGB, (height, width, 3), of a spot whose diameter is a tenth of the shorter
            side.
    """
    height, width = light.shape[:2]
    reach = min(height, width) // 50
    spot = light[height // 2 - reach : height // 2 + reach, width // 2 - reach : width // 2 + reach]
    around = light[height // 2 - reach : height // 2 + reach, : width // 4]
    return float(100 * spot[..., 1].mean() / around[..., 1].mean())
