"""Reads and checks annotations in COCO's format.

https://cocodataset.org/#format-data
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from clpipe.base.errors import RequestError
from clpipe.inputs.annotation_keys import COCO, name_unknown
from clpipe.inputs.annotations import (
    MAX_COORDINATE,
    MAX_PIXELS,
    AnnotatedRender,
    Annotations,
    Record,
    are_numbers,
    reject,
)

REQUIRED_LISTS = ("images", "annotations", "categories")


@dataclass(frozen=True)
class Coco(Annotations):
    """Annotations of renders, each with its record in the file.

    Args:
        values: all of its values.
        of_image: the annotations of each image, by the image's id.
    """

    values: Mapping[str, Any]
    of_image: Mapping[Any, Sequence[Record]]


def read_coco(path: Path, values: Any) -> Coco:
    """Return annotations in COCO's format, from the values of a file.

    Raises:
        RequestError: the values are not in COCO's format; the message says where.
    """
    lists = [values.get(name) if isinstance(values, dict) else None for name in REQUIRED_LISTS]
    for name, found in zip(REQUIRED_LISTS, lists, strict=True):
        if not isinstance(found, list) or not all(isinstance(each, dict) for each in found):
            raise RequestError(
                f"--annotations {path}: the list '{name}' is missing; COCO's format has the lists "
                f"{', '.join(REQUIRED_LISTS)}"
            )
    images, annotations, _ = lists
    assert images is not None and annotations is not None
    of_image: dict[Any, list[Record]] = {}
    sizes: dict[Any, tuple[int, int]] = {}
    names: set[str] = set()
    renders: list[AnnotatedRender] = []
    for number, image in enumerate(images):
        size = [image.get(name) for name in ("width", "height")]
        if not all(isinstance(side, int) and 0 < side <= MAX_COORDINATE for side in size):
            allowed = f"whole px from 1 to {MAX_COORDINATE:.0f}"
            reject(path, f"images[{number}]", f"width and height {size}", allowed)
        _check_id(path, f"images[{number}].id", image.get("id"))
        if not isinstance(image.get("file_name"), str) or image["id"] in of_image:
            found = "no file_name, or an id that another image has"
            reject(path, f"images[{number}]", found, "a file_name and a unique id")
        if image["file_name"] in names:
            found = f"the file_name {image['file_name']} of an earlier image"
            reject(path, f"images[{number}]", found, "one entry for each file")
        names.add(image["file_name"])
        sizes[image["id"]] = image["width"], image["height"]
        renders.append(AnnotatedRender(image["file_name"], sizes[image["id"]], image))
        of_image[image["id"]] = []
    for number, each in enumerate(annotations):
        place = f"annotations[{number}]"
        _check_id(path, f"{place}.image_id", each.get("image_id"))
        if each["image_id"] not in of_image:
            expected = "the id of an image in the list images"
            reject(path, place, f"image_id {each['image_id']!r}", expected)
        _check(path, place, each, sizes[each["image_id"]])
        of_image[each["image_id"]].append(each)
    name_unknown(path, COCO, [values, *images, *annotations])
    return Coco(path, renders, values, of_image)


def _check_id(path: Path, place: str, found: Any) -> None:
    """Check that a value can be the id of an image.

    Raises:
        RequestError: it is neither a number nor a string.
    """
    if not isinstance(found, int | float | str):
        reject(path, place, found, "the id of an image, a number or a string")


def _check(path: Path, place: str, annotation: Record, size: tuple[int, int]) -> None:
    """Check that the geometry of an annotation is in COCO's format.

    Args:
        path: the file, for messages.
        place: where the annotation is in the file.
        annotation: its record.
        size: width and height of its image in px.

    Raises:
        RequestError: it is not.
    """
    box, points = annotation.get("bbox"), annotation.get("keypoints", [])
    outline = annotation.get("segmentation", [])
    if box is not None and not are_numbers(box, 4):
        reject(path, f"{place}.bbox", box, "x, y, width and height")
    if not are_numbers(points) or len(points) % 3:
        reject(path, f"{place}.keypoints", points, "x, y and visibility of each keypoint")
    if isinstance(outline, dict):
        if not {"size", "counts"} <= outline.keys():
            reject(path, f"{place}.segmentation", list(outline), "size and counts")
        _check_mask(path, f"{place}.segmentation", outline, size)
    elif not isinstance(outline, list) or not all(
        are_numbers(part) and len(part) >= 6 and len(part) % 2 == 0 for part in outline
    ):
        reject(path, f"{place}.segmentation", outline, "polygons of three points or more")
    if box is None and not outline:
        reject(path, place, "neither bbox nor segmentation", "one of them")


def _check_mask(path: Path, place: str, mask: Record, size: tuple[int, int]) -> None:
    """Check that a run-length encoded mask has the size of its image.

    Raises:
        RequestError: it has not, or is damaged.
    """
    width, height = size
    if mask["size"] != [height, width]:
        expected = f"{[height, width]}, the height and width of its image"
        reject(path, f"{place}.size", mask["size"], expected)
    try:
        runs = runs_of(mask["counts"])
    except ValueError as error:
        reject(path, f"{place}.counts", mask["counts"], f"run lengths ({error})")
    if sum(runs) != width * height:
        reject(path, f"{place}.counts", f"runs of {sum(runs)} pixels", f"{width * height} in all")


def runs_of(counts: Any) -> list[int]:
    """Return the run lengths of a mask, in px, from either of COCO's forms.

    In the compressed form a character holds six bits, counted from "0". Five are bits of a number,
    lowest first. The sixth tells whether the number continues. From the fourth number on, the
    difference to the number two places before is stored (cocoapi, maskApi.c).

    Raises:
        ValueError: the counts are of neither form.

    >>> runs_of([3, 2, 4]), runs_of("08Q1"), runs_of("0805")
    ([3, 2, 4], [0, 8, 33], [0, 8, 0, 13])
    """
    if isinstance(counts, list):
        if not all(type(n) is int and 0 <= n <= MAX_PIXELS for n in counts):
            raise ValueError(f"each count must be a whole number from 0 to {MAX_PIXELS}")
        return counts
    if not isinstance(counts, str):
        raise ValueError("the counts must be a list or a string")
    runs: list[int] = []
    value = shift = 0
    for letter in counts:
        bits = ord(letter) - ord("0")
        if not 0 <= bits < 64 or shift > 30:
            raise ValueError(f"the counts contain the invalid character {letter!r}")
        value |= (bits & 31) << shift
        shift += 5
        if bits & 32:
            continue
        value -= (1 << shift) if bits & 16 else 0
        runs.append(value + (runs[-2] if len(runs) > 2 else 0))
        if runs[-1] < 0:
            raise ValueError(f"they contain {runs[-1]}")
        value = shift = 0
    if shift:
        raise ValueError("they are incomplete")
    return runs
