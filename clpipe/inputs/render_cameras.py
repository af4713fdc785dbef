"""Reads the cameras of renders: clpipe's cameras.json, NeRF's or nerfstudio's transforms.json, or a
folder with COLMAP's text model.
"""

import logging
import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from clpipe.base.about import FORMAT, FORMAT_KEY
from clpipe.base.errors import RequestError
from clpipe.base.reading import parse_json, read_named, read_named_text
from clpipe.base.types import Array
from clpipe.inputs.camera_keys import (
    COLMAP,
    COLMAP_MODELS,
    LENS_LIKE,
    OF_PINHOLE,
    TRANSFORMS,
    check_keys,
)
from clpipe.inputs.manifest import MANIFEST_BYTES
from clpipe.reference.pose import from_opengl, from_quaternion

log = logging.getLogger(__name__)

ANGLES = ("camera_angle_x", "camera_angle_y")  # keys of a transforms.json
ANGLE_TOLERANCE = 0.01  # relative, of the focal length that an angle means


@dataclass(frozen=True)
class View:
    """The camera of a render, read from a file.

    Args:
        name: the name of the image in the file.
        values: values by the keys of :class:`~clpipe.chain.render_camera.RenderCamera`.
        size: width and height in px; None if they are not stated.
        problem: why it is not valid; "" if it is.
    """

    name: str
    values: Mapping[str, Any]
    size: tuple[int, int] | None = None
    problem: str = ""

    @property
    def needs_size(self) -> bool:
        """Whether its focal length depends on the image size, which the file does not state."""
        return self.size is None and "camera_angle_x" in self.values and "fx" not in self.values

    def with_size(self, width: int, height: int) -> "View":
        """Return a copy with an image size in px, and focal lengths from the angles of view.

        If a focal length and an angle contradict each other, the copy has a problem.

        >>> View("a", {"camera_angle_x": math.pi / 2}).with_size(400, 300).values["fx"]
        200.00000000000003
        """
        values = dict(self.values)
        for angle, focal, side in zip(ANGLES, ("fx", "fy"), (width, height), strict=True):
            if not 0 < values.get(angle, 0.0) < math.pi:
                continue
            from_angle = side / 2 / math.tan(values.pop(angle) / 2)
            stated = values.setdefault(focal, from_angle)
            if stated and abs(from_angle / stated - 1) > ANGLE_TOLERANCE:
                problem = (
                    f"{angle} means {focal} = {from_angle:.6g} px in a picture of {width}x{height} "
                    f"px, but {focal} is {stated:.6g} px; correct or remove one of them"
                )
                return replace(self, problem=self.problem or problem)
        return replace(self, values=values, size=(width, height))


def read_views(path: Path) -> list[View]:
    """Return the views of a file or of COLMAP's folder.

    Raises:
        RequestError: it cannot be read, is in an unknown format, or has no view.
    """
    if path.is_dir():
        views = list(_from_colmap(path))
        if not views:
            raise RequestError(f"--poses {path}: its images.txt lists no images")
        return views
    text = read_named("--poses", path, MANIFEST_BYTES)
    try:
        values = parse_json(text)
    except ValueError as error:
        raise RequestError(
            f"--poses {path}: this is not valid JSON ({error}); give a cameras.json, a "
            "transforms.json, or a folder with COLMAP's cameras.txt and images.txt"
        ) from None
    number = values.get(FORMAT_KEY, 0) if isinstance(values, dict) else 0
    if isinstance(number, int) and number > FORMAT:
        raise RequestError(
            f"--poses {path}: a newer clpipe wrote this file: its format has number {number}, and "
            f"this version knows {FORMAT}. Install the newer version"
        )
    for key, parse in PARSERS.items():
        listed = values.get(key) if isinstance(values, dict) else None
        if isinstance(listed, list) and listed:
            if parse is _from_frame:
                keys = {k for each in [values, *listed] if isinstance(each, dict) for k in each}
                # The view of a key like those of lenses has a problem.
                others = sorted(key for key in keys if not LENS_LIKE.fullmatch(key))
                for sentence in TRANSFORMS.warnings(others):
                    log.warning("--poses %s: %s", path, sentence)
            return [
                _parse_view(path, number, each, values, parse) for number, each in enumerate(listed)
            ]
    raise RequestError(
        f"--poses {path}: this file has neither the list 'views' of a cameras.json nor the list "
        "'frames' of a transforms.json; give one of these files, or COLMAP's folder"
    )


Parser = Callable[[Mapping[str, Any], Mapping[str, Any]], View]


def _parse_view(
    path: Path, number: int, record: Any, common: Mapping[str, Any], parse: Parser
) -> View:
    """Return a view, from its record in a JSON file.

    Raises:
        RequestError: the record does not name its image.
    """
    key = "file_path" if parse is _from_frame else "file"
    name = record.get(key) if isinstance(record, dict) else None
    if not isinstance(name, str) or not name:
        raise RequestError(
            f"--poses {path}: view {number + 1} has no '{key}'; add the name of its image"
        )
    try:
        return replace(parse(record, common), name=name)
    except ValueError as error:
        return View(name, {}, problem=str(error))


def _from_view(view: Mapping[str, Any], common: Mapping[str, Any]) -> View:
    """Return a view of a cameras.json.

    Raises:
        ValueError: a value is not allowed; the message names it.
    """
    merged = {**common, **view}
    values: dict[str, Any] = {}
    if "K" in merged:
        k = number_array("K", merged["K"], (3, 3))
        if k[0, 1] or k[1, 0] or k[2].tolist() != [0, 0, 1]:
            raise ValueError(
                f"K: found {k.tolist()}, but expected [[fx, 0, cx], [0, fy, cy], [0, 0, 1]]"
            )
        values = dict(
            zip(("fx", "fy", "cx", "cy"), k[[0, 1, 0, 1], [0, 1, 2, 2]].tolist(), strict=True)
        )
    if ("R" in merged) != ("t" in merged):
        raise ValueError("R or t is missing; give both or neither")
    if "R" in merged:
        values["rotation"] = number_array("R", merged["R"], (3, 3)).tolist()
        values["translation"] = number_array("t", merged["t"], (3,)).tolist()
    coefficients = merged.get("distortion") or {}
    if not isinstance(coefficients, dict):
        raise ValueError(
            f"distortion: found {coefficients!r}, but expected an object of coefficients by name"
        )
    _check_pinhole(str(merged.get("model") or "PINHOLE"), coefficients)
    return View("", values, _size(merged, "width", "height"))


def _from_frame(frame: Mapping[str, Any], common: Mapping[str, Any]) -> View:
    """Return a frame of a transforms.json. Values that the frame lacks are taken from all frames.

    Raises:
        ValueError: a value is not allowed; the message names it.
    """
    merged = {**common, **frame}
    names = {"fl_x": "fx", "fl_y": "fy", "cx": "cx", "cy": "cy", **{a: a for a in ANGLES}}
    values: dict[str, Any] = {
        to: number_array(name, merged[name], ()).item()
        for name, to in names.items()
        if name in merged
    }
    if "transform_matrix" in merged:
        shape = (3, 4) if np.shape(merged["transform_matrix"])[:1] == (3,) else (4, 4)
        matrix = number_array("transform_matrix", merged["transform_matrix"], shape)
        r, t = from_opengl(matrix)
        values |= {"rotation": r.tolist(), "translation": t.tolist()}
    check_keys(merged)
    _check_pinhole(str(merged.get("camera_model") or "PINHOLE"), {})
    view = View("", values)
    size = _size(merged, "w", "h")
    return view.with_size(*size) if size else view


PARSERS: dict[str, Parser] = {"views": _from_view, "frames": _from_frame}


def _from_colmap(folder: Path) -> Iterator[View]:
    """Yield the images of COLMAP's text model, in a folder or its sparse/0.

    Raises:
        RequestError: the model cannot be read.
    """
    folders = [
        candidate
        for candidate in (folder, folder / "sparse" / "0")
        if (candidate / "images.txt").exists()
    ]
    if not folders:
        raise RequestError(
            f"--poses {folder}: there is no images.txt in this folder or its sparse/0; to convert "
            "a binary model, run colmap model_converter --output_type TXT"
        )
    cameras = {}
    for line in _lines(folders[0] / "cameras.txt"):
        if line and not line.startswith("#"):
            identity, *rest = line.split()
            cameras[identity] = rest
    lines = _lines(folders[0] / "images.txt")
    for line in lines:
        if not line or line.startswith("#"):
            continue
        next(lines, "")  # skip the line of 2D points
        _, *fields = line.split(maxsplit=9)
        if len(fields) != 9:
            raise RequestError(
                f"--poses {folders[0] / 'images.txt'}: found the line {line[:80]!r}; expected "
                "IMAGE_ID QW QX QY QZ TX TY TZ CAMERA_ID NAME"
            )
        *pose, camera, name = fields
        try:
            yield _from_image(name, pose, cameras.get(camera, []))
        except ValueError as error:
            yield View(name, {}, problem=str(error))


def _lines(path: Path) -> Iterator[str]:
    text = read_named_text(f"--poses {path}", path, MANIFEST_BYTES)
    return iter([line.strip() for line in text.split("\n")])


def _from_image(name: str, pose: Sequence[str], camera: Sequence[str]) -> View:
    """Return the view of an image in COLMAP's model.

    Args:
        name: the image's file name.
        pose: quaternion and translation, seven numbers.
        camera: model, width, height and parameters, from cameras.txt.

    Raises:
        ValueError: a value is not allowed; the message names it.
    """
    if len(camera) < 4:
        raise ValueError("its camera is missing in cameras.txt")
    model, width, height, *texts = camera
    q, t = np.split(
        number_array("QW QX QY QZ TX TY TZ", [_number(text) for text in pose], (7,)), [4]
    )
    if not q.any():
        raise ValueError("its quaternion is 0")
    parameters = number_array("PARAMS", [_number(text) for text in texts], None).tolist()
    every = COLMAP_MODELS.get(model, "").split()
    names = [name for name in every if name in OF_PINHOLE]
    if every and len(parameters) < len(names):
        raise ValueError(
            f"its camera has {len(parameters)} parameters, but {model} needs {' '.join(names)}"
        )
    known = dict(zip(every, parameters, strict=False))
    unknown = {f"parameter {i + 1}": v for i, v in enumerate(parameters) if i >= len(every)}
    _check_pinhole(model, {k: v for k, v in (known | unknown).items() if k not in OF_PINHOLE})
    values: dict[str, Any] = {name: known[name] for name in names}
    if "f" in values:
        values = {"fx": values.pop("f"), **values}
    values |= {"rotation": from_quaternion(q.tolist()).tolist(), "translation": t.tolist()}
    return View(name, values, _size({"w": _number(width), "h": _number(height)}, "w", "h"))


def _number(text: str) -> Any:
    try:
        return float(text)
    except ValueError:
        return text


def number_array(name: str, value: Any, shape: tuple[int, ...] | None) -> Array:
    """Return a value as a finite float64 array of a shape, or of one axis for None.

    Raises:
        ValueError: the value is anything else; the message contains its name.
    """
    try:
        array = np.array(value, np.float64)
    except (TypeError, ValueError, OverflowError):
        array = np.full(1, np.nan)
    if (array.ndim != 1 if shape is None else array.shape != shape) or not np.isfinite(array).all():
        size = "numbers" if shape is None else " rows of ".join(map(str, shape)) + " numbers"
        found = repr(value)
        shown = f"{found[:200]}..." if len(found) > 200 else found
        expected = "a number" if shape == () else size
        raise ValueError(f"{name}: found {shown}, but expected {expected}")
    return array


def _size(values: Mapping[str, Any], *names: str) -> tuple[int, int] | None:
    """Return the values of the keys for width and height, or None if one is missing.

    Raises:
        ValueError: they are not whole numbers above 0.
    """
    if not set(names) <= values.keys():
        return None
    width, height = (number_array(name, values[name], ()).item() for name in names)
    if not (width == int(width) > 0 and height == int(height) > 0):
        raise ValueError(
            f"found {width:g}x{height:g} pixels, but width and height must be whole numbers above 0"
        )
    return int(width), int(height)


def _check_pinhole(model: str, coefficients: Mapping[str, Any]) -> None:
    """Check that a camera has no distortion, because renders have none.

    Raises:
        ValueError: it has.
    """
    if model not in COLMAP_MODELS:
        known = COLMAP.statements.get(model)
        what = f"has the model {model}" + (f" ({known.meaning})" if known else "")
    elif distortion := ", ".join(f"{k} {v}" for k, v in coefficients.items() if v):
        what = f"of the model {model} has distortion ({distortion})"
    else:
        return
    raise ValueError(
        f"its camera {what}, but renders have no lens distortion; remove it from the file, and let "
        "clpipe warp the picture (see clpipe stages distortion)"
    )
