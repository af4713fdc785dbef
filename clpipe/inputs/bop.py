"""Annotations in BOP's format: scene_gt.json, and the files next to it.

scene_gt_info.json contains boxes and visibility, scene_camera.json contains cameras. The folders
mask and mask_visib contain a PNG for each object of each image:
https://github.com/thodan/bop_toolkit/blob/master/docs/bop_datasets_format.md.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from clpipe.base.text import whole_number
from clpipe.inputs.annotation_keys import BOP, name_unknown
from clpipe.inputs.annotations import (
    MAX_PIXELS,
    AnnotatedRender,
    Annotations,
    Record,
    are_numbers,
    read_json,
    reject,
)

POSES, INFOS, CAMERAS = "scene_gt.json", "scene_gt_info.json", "scene_camera.json"
MASKS = ("mask", "mask_visib")
BOXES = ("bbox_obj", "bbox_visib")
DIGITS = 6  # digits of an image number in file names
MAX_IMAGE_NUMBER = 10**9 - 1  # the largest image number
COUNTS = ("px_count_all", "px_count_valid")  # fields that scale with the size of a mask


@dataclass(frozen=True)
class BopObject:
    """An object in an image.

    Args:
        pose: its record in scene_gt.json, which no stage changes.
        info: its record in scene_gt_info.json; empty if there is none.
        masks: the PNGs of the whole object and of its visible part, by the name of their folder.
    """

    pose: Record
    info: Record
    masks: Mapping[str, Path]


@dataclass(frozen=True)
class Bop(Annotations):
    """A scene: a list of :class:`BopObject` for each image. The name of an image is its number.

    Args:
        cameras: the records of scene_camera.json, by the numbers of the images.
    """

    cameras: Mapping[int, Record]


def read_bop(path: Path) -> Bop:
    """Return a scene, from the path of its scene_gt.json.

    Raises:
        RequestError: a file cannot be read or is not in BOP's format; the message says where.
    """
    poses = _by_image(path)
    infos = _by_image(neighbour) if (neighbour := path.with_name(INFOS)).is_file() else {}
    cameras = _by_image(neighbour) if (neighbour := path.with_name(CAMERAS)).is_file() else {}
    renders: list[AnnotatedRender] = []
    for image, objects in poses.items():
        if not isinstance(objects, list) or not all(isinstance(each, dict) for each in objects):
            reject(path, str(image), objects, "a list of objects")
        object_infos: Any = infos.get(image, [{}] * len(objects))
        if not isinstance(object_infos, list) or len(object_infos) != len(objects):
            reject(
                path.with_name(INFOS), str(image), object_infos, f"a list of {len(objects)} objects"
            )
        found = []
        for number, (pose, info) in enumerate(zip(objects, object_infos, strict=True)):
            _check(path.with_name(INFOS), f"{image}[{number}]", info)
            name = f"{image:0{DIGITS}d}_{number:0{DIGITS}d}.png"
            files = {kind: path.with_name(kind) / name for kind in MASKS}
            masks = {kind: file for kind, file in files.items() if file.is_file()}
            if found and masks.keys() != found[0].masks.keys():
                kind = min({*masks} ^ {*found[0].masks})
                expected = "masks for all objects of an image, or for none"
                reject(path, f"{image}[{number}]", f"no {files[kind]}", expected)
            found.append(BopObject(pose, info, masks))
        renders.append(AnnotatedRender(f"{image:0{DIGITS}d}", None, found))
    for image, camera in cameras.items():
        matrix = camera.get("cam_K", [0] * 9) if isinstance(camera, dict) else None
        if not are_numbers(matrix, 9):
            reject(path.with_name(CAMERAS), f"{image}.cam_K", matrix, "nine numbers")
    objects_of_all = [each for render in renders for each in render.content]
    records = [record for each in objects_of_all for record in (each.pose, each.info)]
    name_unknown(path, BOP, [*records, *cameras.values()])
    return Bop(path, renders, cameras)


def is_by_image(values: Any) -> bool:
    """Return whether values have BOP's form: a dict whose keys are numbers of images."""
    return isinstance(values, dict) and bool(values) and all(key.isdecimal() for key in values)


def _by_image(path: Path) -> dict[int, Record]:
    values = read_json(path)
    if not is_by_image(values):
        reject(path, "the file", values, "an object whose keys are numbers of images")
    for key in values:
        if not 0 <= whole_number(key) <= MAX_IMAGE_NUMBER:
            expected = f"a number from 0 to {MAX_IMAGE_NUMBER}; renumber this image"
            reject(path, "the number of an image", key, expected)
    return {int(key): value for key, value in values.items()}


def _check(path: Path, place: str, info: Record) -> None:
    if not isinstance(info, dict):
        reject(path, place, info, "an object")
    for name in BOXES:
        if not are_numbers(box := info.get(name, [0] * 4), 4):
            reject(path, f"{place}.{name}", box, "x, y, width and height")
    for name in COUNTS:
        count = info.get(name, 0)
        if not isinstance(count, int | float) or not 0 <= count <= MAX_PIXELS:
            reject(path, f"{place}.{name}", count, "a number of pixels")
