"""Warps annotations like the pixels of their pictures: boxes, polygons, masks and keypoints."""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import numpy as np

from clpipe.base.types import Array, Doubles, Mask
from clpipe.inputs.annotations import Record
from clpipe.inputs.coco import runs_of
from clpipe.reference.carried import Layer, warp
from clpipe.reference.geometry import (
    Composition,
    Geometry,
    Margins,
    Orientation,
    destinations,
)
from clpipe.reference.intrinsics import Intrinsics

STEP = 2.0  # px: the length of the segments into which an outline is divided
SIMPLER = 0.05  # px: the tolerance with which a mapped outline is simplified
MOST_PLACES = 4096  # of a mask, sampled to find how much of it is cut off
LEAST = 0.5  # px^2: an object whose visible area is smaller is dropped


@dataclass(frozen=True)
class Way:
    """The mapping from points of a render to points of a picture.

    Args:
        geometry: how pixels move; None if they do not.
        width, height: size of the render in px, without overscan.
        margins: the overscan of the render.
        after: width and height of the picture in px.
    """

    geometry: Geometry | None
    width: int
    height: int
    margins: Margins
    after: tuple[int, int]

    def places(self, points: Array) -> Doubles:
        """Return the picture's x and y of points of the render; NaN if they cannot be shown.

        Args:
            points: x and y in px from the render's corner, (point, 2).
        """
        corner = np.array([self.margins.left, self.margins.top])
        at = (np.asarray(points, np.float64) + corner).T
        if self.geometry is None:
            return np.asarray(at.T)
        whole = self.margins.image_size(self.width, self.height)
        start = at * (np.array(self.after) / np.array(whole))[:, None]
        there = destinations(self.geometry, (at[0], at[1]), (start[0], start[1]), *whole)
        return np.stack(there, -1)

    def shows(self, points: Array, there: Doubles) -> Mask:
        """Return whether each point is inside both the render and the picture.

        Args:
            points: x and y in the render, (point, 2).
            there: x and y in the picture, (point, 2).
        """
        left, top, right, bottom = self.margins
        low, high = [-left, -top], [self.width + right, self.height + bottom]
        with np.errstate(invalid="ignore"):
            inside = (there >= 0) & (there <= np.array(self.after))
        return np.asarray((inside & (points >= low) & (points <= high)).all(-1))

    @property
    def is_turned(self) -> bool:
        """Whether the picture is flipped or rotated."""
        parts = self.geometry.parts if isinstance(self.geometry, Composition) else ()
        return any(isinstance(part, Orientation) for part in parts)

    def camera(self, before: Intrinsics) -> Intrinsics | None:
        """Return the intrinsics of the picture; None if they are unknown, or if it is rotated.

        Args:
            before: the intrinsics of the render.

        Raises:
            RequestError: a stage that moves pixels contradicts them.
        """
        size = self.margins.image_size(self.width, self.height)
        return self.geometry.intrinsics(before, *size) if self.geometry else before


def mapped_annotation(annotation: Record, way: Way) -> Record | None:
    """Return the values of an annotation that change; None if its object is not in the picture.

    The box is that of the mapped outline or mask. Without either, it encloses the mapped edges of
    the old box. ``truncated`` is the share of the object outside the picture.

    Raises:
        ImageError: a mask differs from its image in size.
    """
    outline = annotation.get("segmentation") or None
    changed: Record = {}
    if isinstance(outline, dict):
        found = _mapped_mask(outline, way)
        if found is None:
            return None
        changed |= found
    else:
        parts = outline or [_box_outline(annotation["bbox"])]
        clipped = _mapped_outline([np.reshape(part, (-1, 2)) for part in parts], way)
        if clipped is None:
            return None
        polygons, share = clipped
        changed["bbox"] = _bounds(polygons)
        area = sum(abs(_area(part)) for part in polygons)
        changed |= {"area": round(area, 3), "truncated": round(1 - share, 4)}
        if outline:
            changed["segmentation"] = [part.round(3).ravel().tolist() for part in polygons]
    if points := annotation.get("keypoints"):
        changed |= _mapped_keypoints(points, way)
    return changed


def mapped_box(box: Sequence[float], way: Way) -> tuple[list[float], float] | None:
    """Return the box around the mapped edges of a box, and the share of it in the picture.

    Return None if nothing of the box is in the picture. Boxes are x, y, width and height in px.
    """
    clipped = _mapped_outline([_box_outline(box)], way)
    if clipped is None:
        return None
    outlines, share = clipped
    return _bounds(outlines), share


def _bounds(outlines: Sequence[Array]) -> list[float]:
    """Return the bounding box of outlines: x, y, width and height."""
    low = np.min([part.min(0) for part in outlines], 0)
    high = np.max([part.max(0) for part in outlines], 0)
    return [*low.round(3).tolist(), *(high - low).round(3).tolist()]


def moved_mask(mask: Array, way: Way) -> Array:
    """Return a mask of the render, (height, width) of 0 and 1, warped into the picture."""
    layer = Layer("label", mask[..., None], way.margins.left, way.margins.top)
    (moved,), _ = warp([layer], way.geometry, *way.margins.image_size(way.width, way.height))
    return np.asarray(moved[..., 0])


def _box_outline(box: Sequence[float]) -> Array:
    x, y, width, height = box
    return np.array([[x, y], [x + width, y], [x + width, y + height], [x, y + height]])


def _area(outline: Array) -> float:
    """Return the signed area in px^2 of an outline, (corner, 2)."""
    x, y = outline.T
    return float(x @ np.roll(y, -1) - y @ np.roll(x, -1)) / 2


def _mapped_outline(parts: Sequence[Array], way: Way) -> tuple[list[Array], float] | None:
    """Return outlines in the picture, and the share of their area in it; None if none is."""
    from shapely import Polygon, box, make_valid
    from shapely.ops import unary_union

    left, top, right, bottom = way.margins
    render = box(-left, -top, way.width + right, way.height + bottom)
    picture = box(0, 0, *way.after)
    whole, shown = 0.0, []
    for part in parts:
        own = make_valid(Polygon(part))
        whole += _mapped(own, way)[0]
        _, pieces = _mapped(own.intersection(render), way)
        shown += [piece.intersection(picture) for piece in pieces]
    kept = unary_union(shown).simplify(SIMPLER)
    outlines = [np.array(piece.exterior.coords)[:-1] for piece in _polygons(kept)]
    if sum(abs(_area(each)) for each in outlines) < LEAST:
        return None
    return outlines, min(sum(each.area for each in shown) / whole, 1.0)


def _polygons(shape: Any) -> list[Any]:
    """Return the polygons in a shape of shapely's."""
    parts = getattr(shape, "geoms", [shape])
    return [each for each in parts if each.geom_type == "Polygon" and each.area > 0]


def _mapped(shape: Any, way: Way) -> tuple[float, list[Any]]:
    """Return the area of a shape after mapping, with its hidden parts, and its visible polygons."""
    from shapely import Polygon, make_valid

    area, found = 0.0, []
    for polygon in _polygons(shape):
        corners = np.array(polygon.exterior.coords)
        dense = np.concatenate(
            [
                np.linspace(a, b, max(int(np.hypot(*(b - a)) / STEP), 1), endpoint=False)
                for a, b in pairwise(corners)
            ]
        )
        there = way.places(dense)
        known = np.isfinite(there).all(-1)
        if known.sum() >= 3:
            moved = make_valid(Polygon(there[known]))
            area += moved.area / known.mean()
            found += _polygons(moved)
    return area, found


def _mapped_mask(encoded: Record, way: Way) -> Record | None:
    """Return a run-length encoded mask in the picture, with its area and box; None if it is empty.

    Raises:
        ImageError: the mask differs from its image in size.
    """
    from pycocotools import mask as coder

    is_text = not isinstance(encoded["counts"], list)
    runs = runs_of(encoded["counts"])
    values = np.arange(len(runs), dtype=np.uint8) % 2
    mask = np.repeat(values, runs).reshape((way.height, way.width), order="F")
    moved = moved_mask(mask, way)
    if not moved.any():
        return None
    packed = coder.encode(np.asfortranarray(moved))
    counts: Any = packed["counts"].decode("ascii")
    if not is_text:
        flat = moved.ravel(order="F")
        edges = np.flatnonzero(np.diff(np.concatenate([[0], flat, [2]])))
        counts = np.diff(np.concatenate([[0], edges])).tolist()
    y, x = np.nonzero(mask)
    some = slice(None, None, max(len(x) // MOST_PLACES, 1))
    points = np.stack([x[some], y[some]], -1) + 0.5
    return {
        "segmentation": {"size": list(moved.shape), "counts": counts},
        "bbox": coder.toBbox(packed).tolist(),
        "area": float(moved.sum()),
        "truncated": round(1 - float(way.shows(points, way.places(points)).mean()), 4),
    }


def _mapped_keypoints(points: Sequence[float], way: Way) -> Record:
    """Return keypoints in the picture. Those outside it become unlabelled: 0, 0, 0."""
    found = np.reshape(np.asarray(points, np.float64), (-1, 3))
    there = way.places(found[:, :2])
    inside = way.shows(found[:, :2], there) & (found[:, 2] > 0)
    kept = np.where(inside[:, None], np.column_stack([there.round(3), found[:, 2]]), 0)
    values = [int(v) if i % 3 == 2 else v for i, v in enumerate(kept.ravel().tolist())]
    return {"keypoints": values, "num_keypoints": int(inside.sum())}
