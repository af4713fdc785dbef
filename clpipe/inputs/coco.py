"""Annotations of renders in COCO's format, read and checked.

https://cocodataset.org/#format-data
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from clpipe.base.errors import RequestError
from clpipe.inputs.annotations import AnnotatedRender, Record, refuse

LISTS = ("images", "annotations", "categories")


@dataclass(frozen=True)
class Coco:
    """Annotations of renders, see :class:`~clpipe.inputs.annotations.Annotations`.

    Args:
        file: where they are from.
        values: the whole of it.
        of_image: the annotations of each image, by its id.
    """

    file: Path
    values: Mapping[str, Any]
    of_image: Mapping[Any, Sequence[Record]]

    @property
    def renders(self) -> list[AnnotatedRender]:
        """The records of the images."""
        return [
            AnnotatedRender(image["file_name"], (image["width"], image["height"]), image)
            for image in self.values["images"]
        ]


def read_coco(path: Path, values: Any) -> Coco:
    """Annotations in COCO's format, from the values of a file.

    Raises:
        RequestError: they are of another form; the message says where.
    """
    lists = [values.get(name) if isinstance(values, dict) else None for name in LISTS]
    for name, found in zip(LISTS, lists, strict=True):
        if not isinstance(found, list) or not all(isinstance(each, dict) for each in found):
            raise RequestError(f"--annotations {path}: has no list '{name}', as COCO's format has")
    images, annotations, _ = lists
    assert images is not None and annotations is not None
    of_image: dict[Any, list[Record]] = {}
    for number, image in enumerate(images):
        sizes = [image.get(name) for name in ("width", "height")]
        if not all(isinstance(side, int) and side > 0 for side in sizes):
            refuse(path, f"images[{number}]", f"width and height {sizes}", "whole px above 0")
        if not isinstance(image.get("file_name"), str) or image.get("id") in of_image:
            refuse(path, f"images[{number}]", "no file_name, or an id that is there twice", "both")
        of_image[image.get("id")] = []
    for number, each in enumerate(annotations):
        place = f"annotations[{number}]"
        if each.get("image_id") not in of_image:
            refuse(path, place, f"image_id {each.get('image_id')!r}", "that of an image")
        _check(path, place, each)
        of_image[each["image_id"]].append(each)
    return Coco(path, values, of_image)


def _check(path: Path, place: str, annotation: Record) -> None:
    """See that the geometry of an annotation is of COCO's form.

    Raises:
        RequestError: it is not.
    """
    box, points = annotation.get("bbox"), annotation.get("keypoints", [])
    outline = annotation.get("segmentation", [])
    if box is not None and not (_numbers(box) and len(box) == 4):
        refuse(path, f"{place}.bbox", box, "x, y, width and height")
    if not _numbers(points) or len(points) % 3:
        refuse(path, f"{place}.keypoints", points, "x, y and visibility of each")
    if isinstance(outline, dict):
        if not {"size", "counts"} <= outline.keys():
            refuse(path, f"{place}.segmentation", list(outline), "size and counts")
    elif not isinstance(outline, list) or not all(
        _numbers(part) and len(part) >= 6 and len(part) % 2 == 0 for part in outline
    ):
        refuse(path, f"{place}.segmentation", outline, "outlines of three places and more")
    if box is None and not outline:
        refuse(path, place, "neither bbox nor segmentation", "one of them")


def _numbers(values: Any) -> bool:
    return isinstance(values, list) and all(
        isinstance(v, int | float) and np.isfinite(v) for v in values
    )
