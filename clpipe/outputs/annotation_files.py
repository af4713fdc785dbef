"""Writes annotations of pictures in the format of the renders' annotations: COCO, KITTI or BOP."""

from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path, PurePosixPath
from typing import Any

import numpy as np

from clpipe.base.errors import ImageError
from clpipe.base.files import write_new
from clpipe.base.types import Array, Doubles
from clpipe.images.samples import read_whole_numbers
from clpipe.images.write import write_png
from clpipe.inputs.annotations import AnnotatedRender, Annotations, Record
from clpipe.inputs.bop import BOXES, CAMERAS, COUNTS, DIGITS, INFOS, MASKS, POSES, Bop, BopObject
from clpipe.inputs.coco import Coco
from clpipe.inputs.kitti import CALIBRATION, CENTRE, MATRICES, Kitti, KittiObject
from clpipe.outputs.annotation_warp import PixelMapping, warp_annotation, warp_box, warp_mask
from clpipe.outputs.output_pictures import lens_record, simplest_model
from clpipe.outputs.sidecar import json_text
from clpipe.reference.intrinsics import PINHOLE, Intrinsics

ANNOTATIONS = "annotations.json"
LABELS = "label_2"
EMPTY_BOX = [-1, -1, -1, -1]  # BOP's box of an invisible object
CAMERA_MATRIX = (0, 4, 2, 5)  # the indices of fx, fy, cx and cy in a camera matrix of nine numbers
ORIENTATION_ERROR = "flipped and rotated patches have no poses; run without --augment"


class AnnotationWriter(ABC):
    """Collects the annotations of an output directory's pictures, and writes them."""

    @abstractmethod
    def add(self, file: str, mapping: PixelMapping, render: AnnotatedRender) -> int:
        """Add the annotations of a picture.

        Args:
            file: the picture's path in the folder.
            mapping: the mapping from the render to the picture.
            render: the annotations of its render.

        Returns:
            The number of objects in the picture.

        Raises:
            ImageError: the annotations cannot be mapped.
        """

    @abstractmethod
    def write(self, folder: Path) -> list[Path]:
        """Write all annotations, and return the files and folders that were written.

        Raises:
            ImageError: a file cannot be written.
        """


def annotation_writer(annotations: Annotations) -> AnnotationWriter:
    """Return an empty collection in the format of the renders' annotations."""
    if isinstance(annotations, Kitti):
        return KittiWriter(annotations)
    if isinstance(annotations, Bop):
        return BopWriter(annotations)
    assert isinstance(annotations, Coco)
    return CocoWriter(annotations)


class CocoWriter(AnnotationWriter):
    """COCO: one file for all pictures."""

    def __init__(self, coco: Coco) -> None:
        self._coco = coco
        self._images: list[Record] = []
        self._annotations: list[Record] = []

    def add(self, file: str, mapping: PixelMapping, render: AnnotatedRender) -> int:
        source, (width, height) = render.content, mapping.picture_size
        mapped = [
            {**each, **changes}
            for each in self._coco.of_image[source["id"]]
            if (changes := warp_annotation(each, mapping))
        ]
        changes = {"id": len(self._images) + 1, "file_name": file, "width": width, "height": height}
        self._images.append(source | changes)
        for each in mapped:
            ids = {"id": len(self._annotations) + 1, "image_id": len(self._images)}
            self._annotations.append({**each, **ids})
        return len(mapped)

    def write(self, folder: Path) -> list[Path]:
        lists = {"images": self._images, "annotations": self._annotations}
        path = folder / ANNOTATIONS
        write_new(path, json_text({**self._coco.values, **lists}).encode())
        return [path]


class KittiWriter(AnnotationWriter):
    """KITTI: a label per picture, and a calibration if its render has one.

    Positions and angles are in camera space and do not change. Objects that cover less than half a
    square pixel of the picture are dropped.
    """

    def __init__(self, kitti: Kitti) -> None:
        self._kitti = kitti
        self._texts: dict[str, str] = {}

    def add(self, file: str, mapping: PixelMapping, render: AnnotatedRender) -> int:
        if mapping.is_reoriented:
            raise ImageError(ORIENTATION_ERROR)
        lines = [line for each in render.content if (line := _kitti_line(each, mapping))]
        name = PurePosixPath(file).with_suffix(".txt")
        self._texts[f"{LABELS}/{name}"] = "".join(f"{line}\n" for line in lines)
        if known := self._kitti.calibrations.get(render.name):
            self._texts[f"{CALIBRATION}/{name}"] = _kitti_calibration(known, mapping)
        return len(lines)

    def write(self, folder: Path) -> list[Path]:
        for name, text in self._texts.items():
            write_new(folder / name, text.encode())
        return [folder / name for name in dict.fromkeys(name.split("/")[0] for name in self._texts)]


def _kitti_line(label: KittiObject, mapping: PixelMapping) -> str:
    """Return a line of a label; "" if its box is not in the picture."""
    left, top, right, bottom = label.box
    warped = warp_box([left, top, right - left, bottom - top], mapping)
    if warped is None:
        return ""
    (x, y, width, height), shown = warped
    fields = list(label.fields)
    if label.truncated >= 0:
        fields[1] = f"{1 - (1 - label.truncated) * shown:.2f}"
    # KITTI's coordinates count from the centre of the first pixel, so the last one is width - 1.
    corners = np.reshape([x, y, x + width, y + height], (2, 2)) - CENTRE
    edges = np.clip(corners, 0, np.array(mapping.picture_size) - 1)
    fields[4:8] = [f"{edge:.2f}" for edge in edges.ravel()]
    return " ".join(fields)


def _kitti_calibration(calibration: Mapping[str, Doubles], mapping: PixelMapping) -> str:
    lines = []
    for name, values in calibration.items():
        picture_values = values
        if name in MATRICES:
            matrix = values.reshape(3, 4)
            camera = _picture_camera(matrix[:, :3].ravel(), mapping)
            before = matrix[:, :3]
            picture_values = (_camera_matrix(camera) @ np.linalg.solve(before, matrix)).ravel()
        lines.append(f"{name}: {' '.join(f'{value:.12e}' for value in picture_values)}\n")
    return "".join(lines)


class BopWriter(AnnotationWriter):
    """BOP: scene_gt.json, scene_gt_info.json, scene_camera.json and masks.

    Poses are in camera space and do not change. Images have the numbers of their renders if each
    render has one picture. Otherwise they are numbered from 0. scene_camera.json lists their files.
    """

    def __init__(self, bop: Bop) -> None:
        self._bop = bop
        self._pictures: list[tuple[str, AnnotatedRender, Record, list[_WarpedObject]]] = []

    def add(self, file: str, mapping: PixelMapping, render: AnnotatedRender) -> int:
        if mapping.is_reoriented:
            raise ImageError(ORIENTATION_ERROR)
        camera: Record = {"file_name": file}
        if known := self._bop.cameras.get(int(render.name)):
            camera = {**known, **camera}
            if "cam_K" in known:
                picture_camera = _picture_camera(known["cam_K"], mapping)
                camera["cam_K"] = _camera_matrix(picture_camera).ravel().tolist()
                if picture_camera.model != PINHOLE:  # BOP cannot describe distortion
                    camera |= lens_record(picture_camera)
        objects = [_WarpedObject(each, mapping) for each in render.content]
        self._pictures.append((file, render, camera, objects))
        return sum(each.is_in_picture for each in objects)

    def write(self, folder: Path) -> list[Path]:
        names = [render.name for _, render, _, _ in self._pictures]
        one_picture_each = len(set(names)) == len(names)
        poses: Record = {}
        infos: Record = {}
        cameras: Record = {}
        written: dict[str, Record] = {POSES: poses, INFOS: infos, CAMERAS: cameras}
        for number, (_, render, camera, objects) in enumerate(self._pictures):
            image = int(render.name) if one_picture_each else number
            visible = [each for each in objects if each.is_in_picture]
            poses[str(image)] = [each.original.pose for each in visible]
            infos[str(image)] = [each.info for each in visible]
            cameras[str(image)] = camera
            for index, each in enumerate(visible):
                for kind, mask in each.masks.items():
                    name = f"{image:0{DIGITS}d}_{index:0{DIGITS}d}.png"
                    (folder / kind).mkdir(parents=True, exist_ok=True)
                    write_png(folder / kind / name, np.where(mask, 255, 0).astype(np.uint8))
        for name, values in written.items():
            write_new(folder / name, json_text(values).encode())
        kinds = dict.fromkeys(
            k for *_, objects in self._pictures for each in objects for k in each.masks
        )
        return [folder / name for name in (*written, *kinds)]


class _WarpedObject:
    """An object of a BOP dataset in a picture.

    Args:
        original: the object in the render.
        mapping: the mapping from the render to the picture.
    """

    def __init__(self, original: BopObject, mapping: PixelMapping) -> None:
        self.original = original
        self.masks: dict[str, Array] = {}
        self.info: Record = dict(original.info)
        counts: dict[str, tuple[int, int]] = {}  # px in the render and in the picture
        shares: list[float] = []
        for kind, box in zip(MASKS, BOXES, strict=True):
            if kind in original.masks:
                before = _mask(original.masks[kind], mapping)
                self.masks[kind] = warped = warp_mask(before, mapping)
                counts[kind] = int(before.sum()), int(warped.sum())
                self.info[box] = _bounding_box(warped)
            elif box in original.info and original.info[box] != EMPTY_BOX:
                warped_box = warp_box(original.info[box], mapping)
                self.info[box] = [round(v) for v in warped_box[0]] if warped_box else EMPTY_BOX
                shares.append(warped_box[1] if warped_box else 0.0)
        self.is_in_picture = (
            any(n for _, n in counts.values()) if counts else any(shares) or not shares
        )
        whole, seen = counts.get(MASKS[0]), counts.get(MASKS[1])
        if whole and whole[0]:
            growth = whole[1] / whole[0]
            for name in COUNTS:
                if name in original.info:
                    self.info[name] = round(original.info[name] * growth)
        if seen:
            self.info["px_count_visib"] = seen[1]
            if self.info.get("px_count_all"):
                self.info["visib_fract"] = min(seen[1] / self.info["px_count_all"], 1.0)


def _mask(path: Path, mapping: PixelMapping) -> Array:
    """Return a mask from a file: (height, width) of 0 and 1.

    Raises:
        ImageError: the file cannot be read, or differs from the render in size.
    """
    mask = read_whole_numbers(path)
    if mask.shape[1::-1] != (mapping.width, mapping.height):
        raise ImageError(
            f"{path}: this mask has {mask.shape[1]}x{mask.shape[0]} pixels, but its render has "
            f"{mapping.width}x{mapping.height}; render both at one size"
        )
    return (mask > 0).astype(np.uint8)


def _bounding_box(mask: Array) -> list[int]:
    """Return the bounding box of a mask in whole pixels: x, y, width and height."""
    rows, columns = np.nonzero(mask)
    if not rows.size:
        return EMPTY_BOX
    x, y = int(columns.min()), int(rows.min())
    return [x, y, int(columns.max()) + 1 - x, int(rows.max()) + 1 - y]


def _picture_camera(matrix: Sequence[float] | Array, mapping: PixelMapping) -> Intrinsics:
    """Return the picture's camera, from the matrix of its render.

    In both, (0, 0) is the centre of the first pixel.

    Raises:
        ImageError: the camera is not known.
    """
    fx, fy, cx, cy = (float(matrix[i]) for i in CAMERA_MATRIX)
    before = Intrinsics(mapping.width, mapping.height, fx, fy, cx + CENTRE, cy + CENTRE)
    camera = mapping.camera(before)
    if camera is None:
        raise ImageError("the picture's intrinsics are unknown, so its camera cannot be written")
    return replace(simplest_model(camera), cx=camera.cx - CENTRE, cy=camera.cy - CENTRE)


def _camera_matrix(camera: Intrinsics) -> Any:
    return np.array([[camera.fx, 0, camera.cx], [0, camera.fy, camera.cy], [0, 0, 1]], float)
