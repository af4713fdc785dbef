"""Annotations of renders in COCO's format, read and checked.

https://cocodataset.org/#format-data
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from clpipe.base.errors import RequestError
from clpipe.inputs.annotations import FARTHEST, MOST_PIXELS, AnnotatedRender, Record, refuse

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
    sizes_of: dict[str, tuple[int, int]] = {}
    names: dict[Any, str] = {}
    for number, image in enumerate(images):
        sizes = [image.get(name) for name in ("width", "height")]
        if not all(isinstance(side, int) and 0 < side <= FARTHEST for side in sizes):
            allowed = f"whole px from 1 to {FARTHEST:.0f}"
            refuse(path, f"images[{number}]", f"width and height {sizes}", allowed)
        _check_id(path, f"images[{number}].id", image.get("id"))
        if not isinstance(image.get("file_name"), str) or image["id"] in of_image:
            refuse(path, f"images[{number}]", "no file_name, or an id that is there twice", "both")
        if image["file_name"] in sizes_of:
            refuse(path, f"images[{number}]", f"{image['file_name']} a second time", "it once")
        sizes_of[image["file_name"]] = (image["width"], image["height"])
        of_image[image["id"]] = []
        names[image["id"]] = image["file_name"]
    for number, each in enumerate(annotations):
        place = f"annotations[{number}]"
        _check_id(path, f"{place}.image_id", each.get("image_id"))
        if each["image_id"] not in of_image:
            refuse(path, place, f"image_id {each['image_id']!r}", "that of an image")
        _check(path, place, each, sizes_of[names[each["image_id"]]])
        of_image[each["image_id"]].append(each)
    return Coco(path, values, of_image)


def _check_id(path: Path, place: str, found: Any) -> None:
    """Check that a value can identify an image.

    Raises:
        RequestError: it is neither a number nor a text.
    """
    if not isinstance(found, int | float | str):
        refuse(path, place, found, "the id of an image, a number or a text")


def _check(path: Path, place: str, annotation: Record, size: tuple[int, int]) -> None:
    """See that the geometry of an annotation is of COCO's form, in an image of that size.

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
        _check_mask(path, f"{place}.segmentation", outline, size)
    elif not isinstance(outline, list) or not all(
        _numbers(part) and len(part) >= 6 and len(part) % 2 == 0 for part in outline
    ):
        refuse(path, f"{place}.segmentation", outline, "outlines of three places and more")
    if box is None and not outline:
        refuse(path, place, "neither bbox nor segmentation", "one of them")


def _check_mask(path: Path, place: str, mask: Record, size: tuple[int, int]) -> None:
    """See that a run-length encoded mask is one of an image of that size.

    Raises:
        RequestError: it is not.
    """
    width, height = size
    if mask["size"] != [height, width]:
        refuse(path, f"{place}.size", mask["size"], f"{[height, width]}, height and width")
    try:
        runs = runs_of(mask["counts"])
    except ValueError as error:
        refuse(path, f"{place}.counts", mask["counts"], f"run lengths ({error})")
    if sum(runs) != width * height:
        refuse(path, f"{place}.counts", f"runs of {sum(runs)} pixels", f"{width * height} in all")


def runs_of(counts: Any) -> list[int]:
    """The lengths of the runs of a mask, from both of COCO's forms.

    In the compressed one each number has five bits a character from "0" on, least first, and a
    sixth that says whether there are more; from the fourth on it is the difference to the last but
    one (cocoapi, maskApi.c).

    Raises:
        ValueError: it is none.

    >>> runs_of([3, 2, 4]), runs_of("08Q1"), runs_of("0805")
    ([3, 2, 4], [0, 8, 33], [0, 8, 0, 13])
    """
    if isinstance(counts, list):
        if not all(type(n) is int and 0 <= n <= MOST_PIXELS for n in counts):
            raise ValueError(f"whole numbers from 0 to {MOST_PIXELS}")
        return counts
    if not isinstance(counts, str):
        raise ValueError("a list or a text")
    runs: list[int] = []
    value = shift = 0
    for letter in counts:
        bits = ord(letter) - ord("0")
        if not 0 <= bits < 64 or shift > 30:
            raise ValueError(f"found {letter!r}")
        value |= (bits & 31) << shift
        shift += 5
        if bits & 32:
            continue
        value -= (1 << shift) if bits & 16 else 0
        runs.append(value + (runs[-2] if len(runs) > 2 else 0))
        if runs[-1] < 0:
            raise ValueError(f"found {runs[-1]}")
        value = shift = 0
    if shift:
        raise ValueError("it is cut off")
    return runs


def _numbers(values: Any) -> bool:
    return isinstance(values, list) and all(
        isinstance(v, int | float) and abs(v) <= FARTHEST for v in values
    )
