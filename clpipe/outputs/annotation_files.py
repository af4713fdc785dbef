"""Writes annotations of pictures in the format of the renders' annotations: COCO, KITTI or BOP."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path, PurePosixPath
from typing import Any, Protocol

import numpy as np

from clpipe.base.errors import ImageError
from clpipe.base.files import write_new
from clpipe.base.types import Array, Doubles
from clpipe.images.openimageio import read_grey
from clpipe.images.write import write_grey_png
from clpipe.inputs.annotations import AnnotatedRender, Annotations, Record
from clpipe.inputs.bop import BOXES, CAMERAS, COUNTS, DIGITS, INFOS, MASKS, POSES, Bop, BopObject
from clpipe.inputs.coco import Coco
from clpipe.inputs.kitti import CALIBRATION, CENTRE, MATRICES, Kitti, KittiObject
from clpipe.outputs.annotated import Way, mapped_annotation, mapped_box, moved_mask
from clpipe.outputs.photographs import lens_record, simplest
from clpipe.outputs.sidecar import json_text
from clpipe.reference.intrinsics import PINHOLE, Intrinsics

ANNOTATIONS = "annotations.json"
LABELS = "label_2"
NOTHING = [-1, -1, -1, -1]  # BOP's box of an invisible object
CAMERA_MATRIX = (0, 4, 2, 5)  # the indices of fx, fy, cx and cy in a camera matrix of nine numbers
TURNED = "flipped and rotated patches have no poses; run without --augment"


class Files(Protocol):
    """Collects the annotations of an output directory's pictures, and writes them."""

    def add(self, file: str, way: Way, render: AnnotatedRender) -> int:
        """Add the annotations of a picture.

        Args:
            file: the picture's path in the folder.
            way: the mapping from the render to the picture.
            render: the annotations of its render.

        Returns:
            The number of objects in the picture.

        Raises:
            ImageError: the annotations cannot be mapped.
        """
        ...

    def write(self, folder: Path) -> list[Path]:
        """Write all annotations, and return the files and folders that were written.

        Raises:
            ImageError: a file cannot be written.
        """
        ...


def files_for(annotations: Annotations) -> Files:
    """Return an empty collection in the format of the renders' annotations."""
    if isinstance(annotations, Kitti):
        return KittiFiles(annotations)
    if isinstance(annotations, Bop):
        return BopFiles(annotations)
    assert isinstance(annotations, Coco)
    return CocoFiles(annotations)


class CocoFiles:
    """COCO: one file for all pictures, see :class:`Files`."""

    def __init__(self, coco: Coco) -> None:
        self._coco = coco
        self._images: list[Record] = []
        self._found: list[Record] = []

    def add(self, file: str, way: Way, render: AnnotatedRender) -> int:
        """See :meth:`Files.add`."""
        source, (width, height) = render.content, way.after
        mapped = [
            {**each, **own}
            for each in self._coco.of_image[source["id"]]
            if (own := mapped_annotation(each, way))
        ]
        own = {"id": len(self._images) + 1, "file_name": file, "width": width, "height": height}
        self._images.append(source | own)
        for each in mapped:
            ids = {"id": len(self._found) + 1, "image_id": len(self._images)}
            self._found.append({**each, **ids})
        return len(mapped)

    def write(self, folder: Path) -> list[Path]:
        """See :meth:`Files.write`."""
        lists = {"images": self._images, "annotations": self._found}
        path = folder / ANNOTATIONS
        write_new(path, json_text({**self._coco.values, **lists}).encode())
        return [path]


class KittiFiles:
    """KITTI: for each picture a label, and a calibration if its render has one; see :class:`Files`.

    Positions and angles are in camera space and do not change. Objects that cover less than half a
    square pixel of the picture are dropped.
    """

    def __init__(self, kitti: Kitti) -> None:
        self._kitti = kitti
        self._texts: dict[str, str] = {}

    def add(self, file: str, way: Way, render: AnnotatedRender) -> int:
        """See :meth:`Files.add`."""
        if way.is_turned:
            raise ImageError(TURNED)
        lines = [line for each in render.content if (line := _kitti_line(each, way))]
        name = PurePosixPath(file).with_suffix(".txt")
        self._texts[f"{LABELS}/{name}"] = "".join(f"{line}\n" for line in lines)
        if known := self._kitti.calibrations.get(render.name):
            self._texts[f"{CALIBRATION}/{name}"] = _kitti_calibration(known, way)
        return len(lines)

    def write(self, folder: Path) -> list[Path]:
        """See :meth:`Files.write`."""
        for name, text in self._texts.items():
            write_new(folder / name, text.encode())
        return [folder / name for name in dict.fromkeys(name.split("/")[0] for name in self._texts)]


def _kitti_line(known: KittiObject, way: Way) -> str:
    """Return a line of a label; "" if its box is not in the picture."""
    left, top, right, bottom = known.box
    found = mapped_box([left, top, right - left, bottom - top], way)
    if found is None:
        return ""
    (x, y, width, height), shown = found
    words = list(known.words)
    if known.truncated >= 0:
        words[1] = f"{1 - (1 - known.truncated) * shown:.2f}"
    # KITTI's coordinates count from the centre of the first pixel, so the last one is width - 1.
    corners = np.reshape([x, y, x + width, y + height], (2, 2)) - CENTRE
    edges = np.clip(corners, 0, np.array(way.after) - 1)
    words[4:8] = [f"{edge:.2f}" for edge in edges.ravel()]
    return " ".join(words)


def _kitti_calibration(known: Mapping[str, Doubles], way: Way) -> str:
    lines = []
    for name, values in known.items():
        own = values
        if name in MATRICES:
            matrix = values.reshape(3, 4)
            camera = _camera_of(matrix[:, :3].ravel(), way)
            before = matrix[:, :3]
            own = (_matrix_of(camera) @ np.linalg.solve(before, matrix)).ravel()
        lines.append(f"{name}: {' '.join(f'{value:.12e}' for value in own)}\n")
    return "".join(lines)


class BopFiles:
    """BOP: scene_gt.json, scene_gt_info.json, scene_camera.json and masks; see :class:`Files`.

    Poses are in camera space and do not change. Images have the numbers of their renders if each
    render has one picture. Otherwise they are numbered from 0. scene_camera.json lists their files.
    """

    def __init__(self, bop: Bop) -> None:
        self._bop = bop
        self._pictures: list[tuple[str, AnnotatedRender, Record, list[_Seen]]] = []

    def add(self, file: str, way: Way, render: AnnotatedRender) -> int:
        """See :meth:`Files.add`."""
        if way.is_turned:
            raise ImageError(TURNED)
        camera: Record = {"file_name": file}
        if known := self._bop.cameras.get(int(render.name)):
            camera = {**known, **camera}
            if "cam_K" in known:
                after = _camera_of(known["cam_K"], way)
                camera["cam_K"] = _matrix_of(after).ravel().tolist()
                if after.model != PINHOLE:  # BOP itself cannot describe distortion
                    camera |= lens_record(after)
        seen = [_Seen(each, way) for each in render.content]
        self._pictures.append((file, render, camera, seen))
        return sum(each.is_there for each in seen)

    def write(self, folder: Path) -> list[Path]:
        """See :meth:`Files.write`."""
        names = [render.name for _, render, _, _ in self._pictures]
        is_one = len(set(names)) == len(names)
        poses: Record = {}
        infos: Record = {}
        cameras: Record = {}
        written: dict[str, Record] = {POSES: poses, INFOS: infos, CAMERAS: cameras}
        for number, (_, render, camera, seen) in enumerate(self._pictures):
            image = int(render.name) if is_one else number
            own = [each for each in seen if each.is_there]
            poses[str(image)] = [each.known.pose for each in own]
            infos[str(image)] = [each.info for each in own]
            cameras[str(image)] = camera
            for place, each in enumerate(own):
                for kind, mask in each.masks.items():
                    name = f"{image:0{DIGITS}d}_{place:0{DIGITS}d}.png"
                    (folder / kind).mkdir(parents=True, exist_ok=True)
                    write_grey_png(folder / kind / name, np.where(mask, 255, 0).astype(np.uint8))
        for name, values in written.items():
            write_new(folder / name, json_text(values).encode())
        kinds = dict.fromkeys(k for *_, seen in self._pictures for each in seen for k in each.masks)
        return [folder / name for name in (*written, *kinds)]


class _Seen:
    """An object of BOP's in a picture.

    Args:
        known: the object in the render.
        way: the mapping from the render to the picture.
    """

    def __init__(self, known: BopObject, way: Way) -> None:
        self.known = known
        self.masks: dict[str, Array] = {}
        self.info: Record = dict(known.info)
        counts: dict[str, tuple[int, int]] = {}  # px in the render and in the picture
        shares: list[float] = []
        for kind, box in zip(MASKS, BOXES, strict=True):
            if kind in known.masks:
                before = _mask(known.masks[kind], way)
                self.masks[kind] = after = moved_mask(before, way)
                counts[kind] = int(before.sum()), int(after.sum())
                self.info[box] = _box_of(after)
            elif box in known.info and known.info[box] != NOTHING:
                found = mapped_box(known.info[box], way)
                self.info[box] = [round(v) for v in found[0]] if found else NOTHING
                shares.append(found[1] if found else 0.0)
        self.is_there = any(n for _, n in counts.values()) if counts else any(shares) or not shares
        whole, seen = counts.get(MASKS[0]), counts.get(MASKS[1])
        if whole and whole[0]:
            grown = whole[1] / whole[0]
            for name in COUNTS:
                if name in known.info:
                    self.info[name] = round(known.info[name] * grown)
        if seen:
            self.info["px_count_visib"] = seen[1]
            if self.info.get("px_count_all"):
                self.info["visib_fract"] = min(seen[1] / self.info["px_count_all"], 1.0)


def _mask(path: Path, way: Way) -> Array:
    """Return a mask from a file: (height, width) of 0 and 1.

    Raises:
        ImageError: the file cannot be read, or differs from the render in size.
    """
    mask = read_grey(path)
    if mask.shape[1::-1] != (way.width, way.height):
        raise ImageError(
            f"{path}: this mask has {mask.shape[1]}x{mask.shape[0]} pixels, but its render has "
            f"{way.width}x{way.height}; render both at one size"
        )
    return (mask > 0).astype(np.uint8)


def _box_of(mask: Array) -> list[int]:
    """Return the bounding box of a mask in whole pixels: x, y, width and height."""
    rows, columns = np.nonzero(mask)
    if not rows.size:
        return NOTHING
    x, y = int(columns.min()), int(rows.min())
    return [x, y, int(columns.max()) + 1 - x, int(rows.max()) + 1 - y]


def _camera_of(matrix: Sequence[float] | Array, way: Way) -> Intrinsics:
    """Return the picture's camera, from the matrix of its render.

    In both, (0, 0) is the centre of the first pixel.

    Raises:
        ImageError: the camera is not known.
    """
    fx, fy, cx, cy = (float(matrix[i]) for i in CAMERA_MATRIX)
    before = Intrinsics(way.width, way.height, fx, fy, cx + CENTRE, cy + CENTRE)
    found = way.camera(before)
    if found is None:
        raise ImageError("the intrinsics of the picture are not known")
    return replace(simplest(found), cx=found.cx - CENTRE, cy=found.cy - CENTRE)


def _matrix_of(camera: Intrinsics) -> Any:
    return np.array([[camera.fx, 0, camera.cx], [0, camera.fy, camera.cy], [0, 0, 1]], float)
