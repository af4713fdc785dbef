"""Depth from a pair of rectified pictures by OpenCV's semi-global matching, and its accuracy.

The method is that of Hirschmüller 2008 ("Stereo processing by semiglobal matching and mutual
information"). OpenCV's version has five directions and Birchfield and Tomasi's cost. The parameters
are those of OpenCV's samples.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from clpipe.base.types import Array, Doubles, Floats, Mask
from tools.reconstruction.views import SAME, View, projected, visible

BLOCK = 5  # px, side of the block over which costs are summed
MARGIN = 5  # px of disparity that the search adds on either side of the scene's range
STEP = 16  # OpenCV searches multiples of 16 disparities, and returns 1/16 px
UNIQUE = 10  # %, margin of the best cost over the second
CONSISTENT = 1  # px, largest difference of left and right disparities
SPECKLE = (50, 2)  # smallest island that is kept, and its largest step of disparity, px


@dataclass(frozen=True)
class Score:
    """The accuracy of depth at pixels that both views see.

    Args:
        places: the number of such pixels.
        found: the share of them with a depth.
        complete: the share with an error below :data:`views.SAME` of the depth.
        median, rms: errors of the depths found, m.
    """

    places: int
    found: float
    complete: float
    median: float
    rms: float


def pairs(views: Sequence[View]) -> list[tuple[int, int]]:
    """Return pairs of neighbours in a row of cameras, as numbers of views, left first.

    Raises:
        ValueError: there are no such pairs.
    """
    placed = sorted((tuple((-v.r.T @ v.t).round(6)[[2, 0]]), n) for n, v in enumerate(views))
    found = [(a, b) for (at, a), (to, b) in pairwise(placed) if at[0] == to[0]]
    if not found:
        raise ValueError("found no two cameras side by side at the same height")
    return found


def true_disparities(left: View, right: View) -> Doubles:
    """Return the disparity of each pixel of the left picture, px."""
    places, _ = projected(left, right)
    return np.arange(left.depth.shape[1]) + 0.5 - places[..., 0]


def match(left: Array, right: Array, lowest: float, highest: float) -> Floats:
    """Compute disparities with OpenCV, px; NaN where it finds none.

    Args:
        left: (height, width, 3) uint8.
        right: like ``left``, of the same size.
        lowest: the smallest disparity of the scene, px.
        highest: the largest one, px.
    """
    import cv2

    first = int(np.floor(lowest)) - MARGIN
    count = -(-(int(np.ceil(highest)) + MARGIN - first) // STEP) * STEP
    matcher = cv2.StereoSGBM_create(
        minDisparity=first,
        numDisparities=count,
        blockSize=BLOCK,
        P1=8 * BLOCK**2,
        P2=32 * BLOCK**2,
        disp12MaxDiff=CONSISTENT,
        uniquenessRatio=UNIQUE,
        speckleWindowSize=SPECKLE[0],
        speckleRange=SPECKLE[1],
    )
    grey = [cv2.cvtColor(each, cv2.COLOR_RGB2GRAY) for each in (left, right)]
    # OpenCV matches only pixels for which all disparities are inside the picture.
    sides = (max(first + count, 0), max(-first, 0))
    wide = [cv2.copyMakeBorder(g, 0, 0, *sides, cv2.BORDER_REPLICATE) for g in grey]
    found = matcher.compute(*wide)[:, sides[0] : sides[0] + left.shape[1]].astype(np.float32) / STEP
    return np.where(found < first, np.float32(np.nan), found)


def halved(image: Array) -> Array:
    """Average 2x2 pixels of a uint8 or float image, (height, width[, 3]), with even sides."""
    is_whole = image.dtype == np.uint8
    wide = image.astype(np.uint16) if is_whole else image
    total = wide[::2, ::2] + wide[::2, 1::2] + wide[1::2, ::2] + wide[1::2, 1::2]
    return ((total + 2) // 4).astype(np.uint8) if is_whole else total / 4


class Pair:
    """A rectified pair of views, with the left view's ground truth at a resolution.

    Args:
        left, right: the views.
        half: whether to use half resolution, by 2x2 means.
    """

    def __init__(self, left: View, right: View, half: bool) -> None:
        disparity, depth, texture = true_disparities(left, right), left.depth, left.texture
        self.seen: Mask = visible(left, right)
        self.half = half
        self.focal = float(left.k[0, 0] * np.linalg.norm(left.r.T @ left.t - right.r.T @ right.t))
        self.shift = float(left.k[0, 2] - right.k[0, 2])
        if half:  # only cells on one surface
            cells = depth.reshape(depth.shape[0] // 2, 2, depth.shape[1] // 2, 2)
            flat = cells.max((1, 3)) - cells.min((1, 3)) < SAME * cells.min((1, 3))
            self.seen = (halved(self.seen.astype(np.float32)) == 1) & flat
            depth, disparity = halved(depth), halved(disparity)
            texture = texture[::2, ::2]
        self.depth, self.texture = depth, texture
        self.range = float(disparity.min()) / (1 + half), float(disparity.max()) / (1 + half)

    def find(self, left: Array, right: Array) -> Floats:
        """Find depth, m, in full-resolution pictures, (height, width, 3) uint8."""
        if self.half:
            left, right = halved(left), halved(right)
        disparity = match(left, right, *self.range) * (1 + self.half) - self.shift
        ahead = np.where(disparity > 0, disparity, np.nan)
        return (self.focal / ahead).astype(np.float32)


def score(found: Floats, depth: Floats, places: Mask) -> Score:
    """Compare depth, NaN where none was found, with the ground truth at some pixels."""
    truth = depth[places].astype(np.float64)
    error = np.abs(found[places] - truth)
    is_found = np.isfinite(error)
    error, reach = error[is_found], SAME * truth[is_found]
    count = len(truth)
    if not len(error):
        return Score(count, 0.0, 0.0, np.nan, np.nan)
    rms = float(np.sqrt((error**2).mean()))
    complete = float(np.count_nonzero(error < reach) / count)
    return Score(count, len(error) / count, complete, float(np.median(error)), rms)
