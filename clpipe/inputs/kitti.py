"""Annotations in KITTI's format: a folder of labels, with the calibration in a folder next to it.

A line of a label lists type, truncated, occluded, alpha, the box, height, width, length, x, y, z
and rotation_y. Results add a score. The box is left, top, right and bottom, in px from the centre
of the first pixel: https://www.cvlibs.net/datasets/kitti (the object development kit's readme).
"""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from clpipe.base.errors import RequestError
from clpipe.base.reading import read_named_text
from clpipe.base.types import Doubles
from clpipe.inputs.annotation_keys import KITTI, name_unknown
from clpipe.inputs.annotations import (
    MAX_BYTES,
    MAX_COORDINATE,
    AnnotatedRender,
    Annotations,
    reject,
)

FIELD_COUNT = 15  # fields of a line, without a score
CALIBRATION = "calib"  # name of the calibration folder, next to the label folder
MATRICES = ("P0", "P1", "P2", "P3")  # projection matrices of the cameras; labels use the third
CENTRE = 0.5  # px from the image's corner to the first pixel's centre


@dataclass(frozen=True)
class KittiObject:
    """A line of a label.

    Args:
        fields: all fields of the line, as text.
        truncated: the share of the object outside the picture; unknown if negative.
        box: left, top, right and bottom, in px from the image's corner.
    """

    fields: tuple[str, ...]
    truncated: float
    box: tuple[float, float, float, float]


@dataclass(frozen=True)
class Kitti(Annotations):
    """A folder of KITTI labels: a list of :class:`KittiObject` for each image.

    Args:
        calibrations: for each image, by its name, the numbers of each line of its calibration, by
            the name of the line.
    """

    calibrations: Mapping[str, Mapping[str, Doubles]]


def read_kitti(folder: Path) -> Kitti:
    """Return the labels and calibrations of a folder.

    Raises:
        RequestError: the folder has no labels, or a file is not in KITTI's format; the message
            says where.
    """
    files = sorted(folder.glob("*.txt"))
    if not files:
        raise RequestError(
            f"--annotations {folder}: this folder has no labels; KITTI's format has a file "
            "NAME.txt for each image NAME"
        )
    renders, calibrations = [], {}
    for path in files:
        renders.append(AnnotatedRender(path.stem, None, _objects(path)))
        calibration_file = folder.parent / CALIBRATION / path.name
        if calibration_file.is_file():
            calibrations[path.stem] = _calibration(calibration_file)
    name_unknown(folder, KITTI, calibrations.values())
    return Kitti(folder, renders, calibrations)


def _lines(path: Path) -> list[str]:
    return read_named_text(f"--annotations {path}", path, MAX_BYTES).splitlines()


def _objects(path: Path) -> list[KittiObject]:
    objects = []
    for number, line in enumerate(_lines(path), 1):
        fields = tuple(line.split())
        if not fields:
            continue
        try:
            numbers = [float(word) for word in fields[1:]]
        except ValueError:
            numbers = []
        if len(numbers) not in (FIELD_COUNT - 1, FIELD_COUNT) or not np.isfinite(numbers).all():
            reject(path, f"line {number}", line, f"a type and {FIELD_COUNT - 1} numbers")
        left, top, right, bottom = numbers[3:7]
        if right < left or bottom < top or max(map(abs, numbers[3:7])) > MAX_COORDINATE:
            reject(
                path, f"line {number}", line, "a box with left <= right and top <= bottom, in px"
            )
        box = left + CENTRE, top + CENTRE, right + CENTRE, bottom + CENTRE
        objects.append(KittiObject(fields, numbers[0], box))
    return objects


def _calibration(path: Path) -> dict[str, Doubles]:
    calibration = {}
    for number, line in enumerate(_lines(path), 1):
        name, colon, rest = line.partition(":")
        if not colon:
            continue
        try:
            values = np.array([float(word) for word in rest.split()])
        except ValueError:
            values = np.empty(0)
        if name in MATRICES and (values.size != 12 or not np.isfinite(values).all()):
            reject(path, f"line {number}", line, "the 12 numbers of a 3x4 matrix")
        calibration[name] = values
    return calibration
