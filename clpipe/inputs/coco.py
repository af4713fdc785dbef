"""Annotations of renders in COCO's format, read and checked.

https://cocodataset.org/#format-data
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NoReturn

import numpy as np

from clpipe.base.errors import RequestError
from clpipe.base.reading import parse_json, read_bytes

LARGEST = 1 << 30  # bytes of a file
LISTS = ("images", "annotations", "categories")

Record = dict[str, Any]


@dataclass(frozen=True)
class Coco:
    """Annotations of renders.

    Args:
        file: where they are from.
        values: the whole of it.
        of_image: the annotations of each image, by its id.
    """

    file: Path
    values: Mapping[str, Any]
    of_image: Mapping[Any, Sequence[Record]]


def read_coco(path: Path) -> Coco:
    """Read annotations in COCO's format.

    Raises:
        RequestError: it cannot be read, or is of another form; the message says where.
    """
    try:
        values = parse_json(read_bytes(path, LARGEST))
    except OSError as error:
        raise RequestError(f"--annotations {path}: cannot be read: {error.strerror}") from None
    except ValueError as error:
        raise RequestError(f"--annotations {path}: no valid JSON ({error})") from None
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
            _refuse(path, f"images[{number}]", f"width and height {sizes}", "whole px above 0")
        if not isinstance(image.get("file_name"), str) or image.get("id") in of_image:
            _refuse(path, f"images[{number}]", "no file_name, or an id that is there twice", "both")
        of_image[image.get("id")] = []
    for number, each in enumerate(annotations):
        place = f"annotations[{number}]"
        if each.get("image_id") not in of_image:
            _refuse(path, place, f"image_id {each.get('image_id')!r}", "that of an image")
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
        _refuse(path, f"{place}.bbox", box, "x, y, width and height")
    if not _numbers(points) or len(points) % 3:
        _refuse(path, f"{place}.keypoints", points, "x, y and visibility of each")
    if isinstance(outline, dict):
        if not {"size", "counts"} <= outline.keys():
            _refuse(path, f"{place}.segmentation", list(outline), "size and counts")
    elif not isinstance(outline, list) or not all(
        _numbers(part) and len(part) >= 6 and len(part) % 2 == 0 for part in outline
    ):
        _refuse(path, f"{place}.segmentation", outline, "outlines of three places and more")
    if box is None and not outline:
        _refuse(path, place, "neither bbox nor segmentation", "one of them")


def _numbers(values: Any) -> bool:
    return isinstance(values, list) and all(
        isinstance(v, int | float) and np.isfinite(v) for v in values
    )


def _refuse(path: Path, place: str, found: Any, expected: str) -> NoReturn:
    text = str(found)
    raise RequestError(f"--annotations {path}: {place}: found {text[:100]}; expected {expected}")
