"""Depth from a pair of rectified pictures by OpenCV's semi-global matching, and how true it is.

Hirschmüller 2008 ("Stereo processing by semiglobal matching and mutual information"), as OpenCV has
it: five directions, Birchfield and Tomasi's cost, parameters as OpenCV's samples set them.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from clpipe.base.types import Array, Doubles, Floats, Mask
from tools.reconstruction.views import SAME, View, seen_from, visible

BLOCK = 5  # px, a side of the block whose costs are added up
MARGIN = 5  # px of disparity that are searched beyond those of the scene, on either side
STEP = 16  # OpenCV searches multiples of so many disparities, and returns 1/16 px
UNIQUE = 10  # %, by which the best cost must be below the second
CONSISTENT = 1  # px, how far the disparities of left and right may differ
SPECKLE = (50, 2)  # px, px: smaller islands of disparities that differ by no more are removed


@dataclass(frozen=True)
class Score:
    """What was found of the places that are seen by both views.

    Args:
        places: how many there are.
        found: the share of them that has a depth.
        complete: the share whose depth is off by less than :data:`scene_views.SAME` of it.
        median, rms: of the errors of those found, m.
    """

    places: int
    found: float
    complete: float
    median: float
    rms: float


def pairs(views: Sequence[View]) -> list[tuple[int, int]]:
    """The numbers of views that are neighbours in a row of cameras, left first.

    Raises:
        ValueError: there are none.
    """
    placed = sorted((tuple((-v.r.T @ v.t).round(6)[[2, 0]]), n) for n, v in enumerate(views))
    found = [(a, b) for (at, a), (to, b) in pairwise(placed) if at[0] == to[0]]
    if not found:
        raise ValueError("found no two cameras at the same height, side by side, to be matched")
    return found


def true_disparities(left: View, right: View) -> Doubles:
    """How far left of its place in the left picture each pixel's is in the right one, px."""
    places, _ = seen_from(left, right)
    return np.arange(left.depth.shape[1]) + 0.5 - places[..., 0]


def match(left: Array, right: Array, lowest: float, highest: float) -> Floats:
    """The disparities that OpenCV finds, px; NaN where it finds none.

    Args:
        left, right: (height, width, 3) uint8, of one size.
        lowest, highest: those of the scene, px.
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
    # It looks for partners of pixels of the left picture that have all disparities only.
    sides = (max(first + count, 0), max(-first, 0))
    wide = [cv2.copyMakeBorder(g, 0, 0, *sides, cv2.BORDER_REPLICATE) for g in grey]
    found = matcher.compute(*wide)[:, sides[0] : sides[0] + left.shape[1]].astype(np.float32) / STEP
    return np.where(found < first, np.float32(np.nan), found)


def halved(image: Array) -> Array:
    """The means of 2x2 pixels: uint8 or float, (height, width[, 3]), both even, to half of them."""
    is_whole = image.dtype == np.uint8
    wide = image.astype(np.uint16) if is_whole else image
    total = wide[::2, ::2] + wide[::2, 1::2] + wide[1::2, ::2] + wide[1::2, 1::2]
    return ((total + 2) // 4).astype(np.uint8) if is_whole else total / 4


class Pair:
    """Two views whose rows are the same, and what is true of the left one, at a resolution.

    Args:
        left, right: the views.
        half: at half resolution, by 2x2 means.
    """

    def __init__(self, left: View, right: View, half: bool) -> None:
        disparity, depth, texture = true_disparities(left, right), left.depth, left.texture
        self.seen: Mask = visible(left, right)
        self.half = half
        self.focal = float(left.k[0, 0] * np.linalg.norm(left.r.T @ left.t - right.r.T @ right.t))
        self.shift = float(left.k[0, 2] - right.k[0, 2])
        if half:  # of whole cells on one surface
            cells = depth.reshape(depth.shape[0] // 2, 2, depth.shape[1] // 2, 2)
            flat = cells.max((1, 3)) - cells.min((1, 3)) < SAME * cells.min((1, 3))
            self.seen = (halved(self.seen.astype(np.float32)) == 1) & flat
            depth, disparity = halved(depth), halved(disparity)
            texture = texture[::2, ::2]
        self.depth, self.texture = depth, texture
        self.range = float(disparity.min()) / (1 + half), float(disparity.max()) / (1 + half)

    def find(self, left: Array, right: Array) -> Floats:
        """The depth that is found in pictures, (height, width, 3) uint8 in full resolution, m."""
        if self.half:
            left, right = halved(left), halved(right)
        disparity = match(left, right, *self.range) * (1 + self.half) - self.shift
        ahead = np.where(disparity > 0, disparity, np.nan)
        return (self.focal / ahead).astype(np.float32)


def score(found: Floats, depth: Floats, places: Mask) -> Score:
    """Compare found depth, NaN where there is none, with the true one at some places."""
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
