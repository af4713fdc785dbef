"""Finds a ColorChecker in a picture."""

from collections.abc import Iterator
from itertools import product

import numpy as np

from clpipe.analysis.quality.charts import CHECKER, GREYS
from clpipe.analysis.quality.grids import numbered
from clpipe.base.types import Array, Doubles
from clpipe.camera.colorimetry import lab_of
from clpipe.reference.image import in_blocks
from clpipe.reference.transfer import inverse_srgb_curve

SEEN = (480, 300)  # px of the longer side of the picture in which patches are sought
ROWS, COLUMNS = 4, 6
FOUND = 10  # patches of 24 that must be found; the places of the others follow from them
STEEP = (15.0, 6.0, 10.0, 3.0)  # levels per px, above which a pixel is at the border of a patch
AREA = (25, 0.045)  # of a patch: the least in px, and the largest share of the picture
MOST_ERROR = 20.0  # mean difference of a* and b* of a chart that is taken for a ColorChecker
SHARE = 0.4  # of the distance of patches, that is measured


def find_checker(picture: Array) -> Doubles | None:
    """Return the patches of a ColorChecker, (24, side, side, 3), or None if there is none.

    The chart may be turned, or seen at an angle. Patches are in the order of
    :data:`~clpipe.analysis.quality.charts.CHECKER`.

    Args:
        picture: sRGB levels, (height, width, 3) uint8.
    """
    steps = [max(max(picture.shape[:2]) // seen, 1) for seen in SEEN]
    small = {step: in_blocks(picture, step).mean((1, 3)) for step in steps}
    for step, steep in product(small, STEEP):
        for places, centres in _grids(_patch_centres(small[step], steep)):
            charts = _charts(places, centres * step + (step - 1) / 2)
            patches = [each for chart in charts if (each := _patches(picture, chart)) is not None]
            best = min(patches, key=_error, default=None)
            if best is not None and _error(best) < MOST_ERROR:
                return best
    return None


def _grids(centres: Doubles) -> Iterator[tuple[Doubles, Doubles]]:
    """Yield the grids of marks: their rows and columns, and their centres, each (mark, 2)."""
    while len(centres) >= FOUND:  # a picture may have other grids
        apart = np.hypot(*np.moveaxis(centres[:, None] - centres, -1, 0))
        surrounded = int(np.sort(apart, axis=1)[:, 1:5].mean(1).argmin())
        grid = numbered(centres - centres[surrounded], 1)
        assert grid is not None
        places, numbers = grid
        if len(places) >= FOUND:
            yield places, centres[numbers]
        centres = np.delete(centres, numbers, axis=0)


def _patch_centres(picture: Doubles, steep: float) -> Doubles:
    """Return the centres of even, square areas of a similar size, (area, 2): y and x."""
    from scipy import ndimage

    smooth = ndimage.median_filter(picture, (3, 3, 1))
    slope = np.max([np.hypot(*np.gradient(smooth[..., c])) for c in range(3)], axis=0)
    labels, count = ndimage.label(slope < steep)
    areas = np.bincount(labels.ravel(), minlength=count + 1)[1:]
    y, x = np.mgrid[: labels.shape[0], : labels.shape[1]].astype(np.float64)

    def mean(values: Doubles) -> Doubles:
        return np.bincount(labels.ravel(), values.ravel(), count + 1)[1:] / areas

    centres = np.column_stack([mean(y), mean(x)])
    yy, xx = mean(y**2) - centres[:, 0] ** 2, mean(x**2) - centres[:, 1] ** 2
    xy = mean(y * x) - centres.prod(1)
    # A square of side s has the variance s^2 / 12 along both axes.
    spread = np.sqrt(np.maximum(yy * xx - xy**2, 1e-9))
    square = (np.abs(areas / (12 * spread) - 1) < 0.2) & (yy + xx < 2.6 * spread)
    square &= (areas >= AREA[0]) & (areas < AREA[1] * labels.size)
    if not square.any():
        return np.zeros((0, 2))
    # The patches are the largest group of areas within a factor of two.
    logs = np.log2(areas[square])
    near = np.abs(logs[:, None] - logs) < 0.5
    group = near[near.sum(1).argmax()]
    return np.asarray(centres[square][group])


def _charts(places: Doubles, points: Doubles) -> Iterator[Doubles]:
    """Yield the centres of all 24 patches, (24, 2), for each way in which marks fit a chart."""
    span = np.ptp(places, axis=0)
    order = np.array(list(product(range(ROWS), range(COLUMNS))), np.float64)
    for tall in (False, True):
        size = np.array([COLUMNS, ROWS] if tall else [ROWS, COLUMNS])
        free = (size - 1 - span).astype(int)
        for shift in product(*(range(each + 1) for each in free)):
            moved = places - places.min(0) + shift
            chart = np.column_stack([order[:, 1], ROWS - 1 - order[:, 0]]) if tall else order
            for at in (chart, size - 1 - chart):
                yield _projected(moved, points, at)


def _projected(places: Doubles, points: Doubles, others: Doubles) -> Doubles:
    """Return where other places of a grid are, by the projection that fits the known ones."""
    ones = np.ones(len(places))
    rows = []
    for axis in (0, 1):
        own, zero = np.column_stack([places, ones]), np.zeros((len(places), 3))
        blocks = (own, zero) if axis == 0 else (zero, own)
        rows.append(np.hstack([*blocks, -points[:, [axis]] * places]))
    solved, *_ = np.linalg.lstsq(np.vstack(rows), points.T.ravel(), rcond=None)
    matrix = np.append(solved, 1).reshape(3, 3)
    mapped = np.column_stack([others, np.ones(len(others))]) @ matrix.T
    return mapped[:, :2] / mapped[:, 2:]


def _patches(picture: Array, centres: Doubles) -> Doubles | None:
    """Return the middles of patches, (24, side, side, 3), or None if one is outside."""
    grid = centres.reshape(ROWS, COLUMNS, 2)
    pitch = np.hypot(*np.diff(grid, axis=1).reshape(-1, 2).T).min()
    half = int(pitch * SHARE / 2)
    corners = np.round(centres).astype(int) - half
    if half < 1 or corners.min() < 0 or (corners + 2 * half > picture.shape[:2]).any():
        return None
    return np.array([picture[y : y + 2 * half, x : x + 2 * half] for y, x in corners], np.float64)


def _error(patches: Doubles) -> float:
    """Return the mean difference of a* and b* from a ColorChecker, after balancing its greys."""
    found, true = (inverse_srgb_curve(np.asarray(p) / 255) for p in (patches.mean((1, 2)), CHECKER))
    gains = true[GREYS].mean(0) / np.maximum(found[GREYS].mean(0), 1e-6)
    return float(np.hypot(*(lab_of(found * gains) - lab_of(true))[:, 1:].T).mean())
