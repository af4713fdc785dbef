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
from clpipe.reference.geometry import Composition, Geometry, Margins, Orientation, destinations
from clpipe.reference.intrinsics import Intrinsics

SEGMENT_LENGTH = 2.0  # px; the length of the segments into which an outline is divided
SIMPLIFY_TOLERANCE = 0.05  # px; the tolerance for simplifying a warped outline
MAX_SAMPLES = 4096  # pixels of a mask that are sampled to estimate how much of the mask is cut off
MIN_AREA = 0.5  # px^2; an object with a smaller visible area is dropped


@dataclass(frozen=True)
class PixelMapping:
    """The mapping from points of a render to points of a picture.

    Args:
        geometry: how pixels move; None if they do not.
        width, height: size of the render in px, without overscan.
        margins: the overscan of the render.
        picture_size: width and height of the picture in px.
    """

    geometry: Geometry | None
    width: int
    height: int
    margins: Margins
    picture_size: tuple[int, int]

    def map_points(self, points: Array) -> Doubles:
        """Return x and y of points in the picture, or NaN where the mapping is undefined.

        Args:
            points: x and y in px from the render's top left corner, (point, 2).
        """
        corner = np.array([self.margins.left, self.margins.top])
        at = (np.asarray(points, np.float64) + corner).T
        if self.geometry is None:
            return np.asarray(at.T)
        whole = self.margins.image_size(self.width, self.height)
        start = at * (np.array(self.picture_size) / np.array(whole))[:, None]
        mapped = destinations(self.geometry, (at[0], at[1]), (start[0], start[1]), *whole)
        return np.stack(mapped, -1)

    def is_visible(self, points: Array, mapped: Doubles) -> Mask:
        """Return for each point whether it is inside both the render and the picture.

        Args:
            points: x and y in the render, (point, 2).
            mapped: x and y in the picture, (point, 2).
        """
        left, top, right, bottom = self.margins
        low, high = [-left, -top], [self.width + right, self.height + bottom]
        with np.errstate(invalid="ignore"):
            inside = (mapped >= 0) & (mapped <= np.array(self.picture_size))
        return np.asarray((inside & (points >= low) & (points <= high)).all(-1))

    @property
    def is_reoriented(self) -> bool:
        """Whether the picture is flipped or rotated."""
        parts = self.geometry.parts if isinstance(self.geometry, Composition) else ()
        return any(isinstance(part, Orientation) for part in parts)

    def camera(self, before: Intrinsics) -> Intrinsics | None:
        """Return the intrinsics of the picture, or None if they are unknown or it is rotated.

        Args:
            before: the intrinsics of the render.

        Raises:
            RequestError: a stage that moves pixels contradicts them.
        """
        size = self.margins.image_size(self.width, self.height)
        return self.geometry.intrinsics(before, *size) if self.geometry else before


def warp_annotation(annotation: Record, mapping: PixelMapping) -> Record | None:
    """Return the changed values of an annotation, or None if its object is not in the picture.

    The box encloses the mapped outline or mask. Without either, it encloses the mapped edges of
    the old box. ``truncated`` is the share of the object outside the picture.

    Raises:
        ImageError: a mask differs from its image in size.
    """
    outline = annotation.get("segmentation") or None
    changes: Record = {}
    if isinstance(outline, dict):
        from_mask = _warp_run_length_mask(outline, mapping)
        if from_mask is None:
            return None
        changes |= from_mask
    else:
        parts = [np.reshape(part, (-1, 2)) for part in outline or ()]
        clipped = _warp_outline(parts or [_corners(annotation["bbox"])], mapping)
        if clipped is None:
            return None
        visible, share = clipped
        changes["bbox"] = _box_around(visible)
        changes |= {"area": round(visible.area, 3), "truncated": round(1 - share, 4)}
        if outline:
            rings = [np.array(part.exterior.coords)[:-1] for part in visible.geoms]
            changes["segmentation"] = [ring.round(3).ravel().tolist() for ring in rings]
    if points := annotation.get("keypoints"):
        changes |= _warp_keypoints(points, mapping)
    return changes


def warp_box(box: Sequence[float], mapping: PixelMapping) -> tuple[list[float], float] | None:
    """Return the box around the mapped edges of a box, and the share of it in the picture.

    Return None if nothing of the box is in the picture. Boxes are x, y, width and height in px.
    """
    clipped = _warp_outline([_corners(box)], mapping)
    return clipped and (_box_around(clipped[0]), clipped[1])


def _box_around(shape: Any) -> list[float]:
    """Return the bounding box of a shapely geometry: x, y, width and height."""
    left, top, right, bottom = shape.bounds
    return [round(value, 3) for value in (left, top, right - left, bottom - top)]


def warp_mask(mask: Array, mapping: PixelMapping) -> Array:
    """Return a mask of the render, (height, width) of 0 and 1, warped into the picture."""
    layer = Layer("label", mask[..., None], mapping.margins.left, mapping.margins.top)
    (warped,), _ = warp(
        [layer], mapping.geometry, *mapping.margins.image_size(mapping.width, mapping.height)
    )
    return np.asarray(warped[..., 0])


def _corners(box: Sequence[float]) -> Array:
    x, y, width, height = box
    return np.array([[x, y], [x + width, y], [x + width, y + height], [x, y + height]])


def _warp_outline(parts: Sequence[Array], mapping: PixelMapping) -> tuple[Any, float] | None:
    """Return the visible shape, and the share of the area in the picture; None if all is outside.

    Args:
        parts: outlines in the render, (corner, 2) each.
        mapping: the mapping to the picture.

    Returns:
        Polygons without holes as a shapely MultiPolygon, and the share.
    """
    from shapely import MultiPolygon, Polygon, box, make_valid
    from shapely.ops import unary_union

    left, top, right, bottom = mapping.margins
    render = box(-left, -top, mapping.width + right, mapping.height + bottom)
    picture = box(0, 0, *mapping.picture_size)
    whole, visible = 0.0, []
    for part in parts:
        valid = make_valid(Polygon(part))
        whole += _warp_shape(valid, mapping)[0]
        _, pieces = _warp_shape(valid.intersection(render), mapping)
        visible += [piece.intersection(picture) for piece in pieces]
    kept = unary_union(visible).simplify(SIMPLIFY_TOLERANCE)
    shown = MultiPolygon([Polygon(piece.exterior) for piece in _polygons(kept)])
    if shown.area < MIN_AREA:
        return None
    return shown, min(sum(each.area for each in visible) / whole, 1.0)


def _polygons(shape: Any) -> list[Any]:
    """Return the polygons in a shapely geometry."""
    parts = getattr(shape, "geoms", [shape])
    return [each for each in parts if each.geom_type == "Polygon" and each.area > 0]


def _warp_shape(shape: Any, mapping: PixelMapping) -> tuple[float, list[Any]]:
    """Return the warped area of a shape, hidden parts included, and its visible polygons."""
    from shapely import Polygon, make_valid

    area, polygons = 0.0, []
    for polygon in _polygons(shape):
        corners = np.array(polygon.exterior.coords)
        dense = np.concatenate(
            [
                np.linspace(a, b, max(int(np.hypot(*(b - a)) / SEGMENT_LENGTH), 1), endpoint=False)
                for a, b in pairwise(corners)
            ]
        )
        mapped = mapping.map_points(dense)
        finite = np.isfinite(mapped).all(-1)
        if finite.sum() >= 3:
            warped = make_valid(Polygon(mapped[finite]))
            area += warped.area / finite.mean()
            polygons += _polygons(warped)
    return area, polygons


def _warp_run_length_mask(encoded: Record, mapping: PixelMapping) -> Record | None:
    """Return a run-length encoded mask in the picture with its area and box, or None if empty.

    Raises:
        ImageError: the mask differs from its image in size.
    """
    from pycocotools import mask as coder

    is_text = not isinstance(encoded["counts"], list)
    runs = runs_of(encoded["counts"])
    values = np.arange(len(runs), dtype=np.uint8) % 2
    mask = np.repeat(values, runs).reshape((mapping.height, mapping.width), order="F")
    warped = warp_mask(mask, mapping)
    if not warped.any():
        return None
    packed = coder.encode(np.asfortranarray(warped))
    counts: Any = packed["counts"].decode("ascii")
    if not is_text:
        flat = warped.ravel(order="F")
        edges = np.flatnonzero(np.diff(np.concatenate([[0], flat, [2]])))
        counts = np.diff(np.concatenate([[0], edges])).tolist()
    y, x = np.nonzero(mask)
    sampled = slice(None, None, max(len(x) // MAX_SAMPLES, 1))
    points = np.stack([x[sampled], y[sampled]], -1) + 0.5
    return {
        "segmentation": {"size": list(warped.shape), "counts": counts},
        "bbox": coder.toBbox(packed).tolist(),
        "area": float(warped.sum()),
        "truncated": round(
            1 - float(mapping.is_visible(points, mapping.map_points(points)).mean()), 4
        ),
    }


def _warp_keypoints(points: Sequence[float], mapping: PixelMapping) -> Record:
    """Return keypoints in the picture. Those outside it become unlabelled: 0, 0, 0."""
    keypoints = np.reshape(np.asarray(points, np.float64), (-1, 3))
    mapped = mapping.map_points(keypoints[:, :2])
    inside = mapping.is_visible(keypoints[:, :2], mapped) & (keypoints[:, 2] > 0)
    kept = np.where(inside[:, None], np.column_stack([mapped.round(3), keypoints[:, 2]]), 0)
    values = [int(v) if i % 3 == 2 else v for i, v in enumerate(kept.ravel().tolist())]
    return {"keypoints": values, "num_keypoints": int(inside.sum())}
