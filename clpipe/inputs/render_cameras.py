"""The cameras of renders, as files hold them: a cameras.json as clpipe writes it, a transforms.json
of NeRF's or nerfstudio's, or a folder with COLMAP's text model.
"""

import math
import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from clpipe.base.errors import RequestError
from clpipe.base.reading import parse_json, read_named
from clpipe.base.types import Array
from clpipe.inputs.manifest import MANIFEST_BYTES
from clpipe.reference.pose import from_opengl, from_quaternion

# The parameters before the coefficients of those of COLMAP's models that can be a pinhole's.
FOCAL_LENGTHS = {
    "SIMPLE_PINHOLE": ("f", "cx", "cy"),
    "PINHOLE": ("fx", "fy", "cx", "cy"),
    "SIMPLE_RADIAL": ("f", "cx", "cy"),
    "RADIAL": ("f", "cx", "cy"),
    "OPENCV": ("fx", "fy", "cx", "cy"),
    "FULL_OPENCV": ("fx", "fy", "cx", "cy"),
}

COEFFICIENT = re.compile(r"[kp][1-6]")


@dataclass(frozen=True)
class View:
    """A render's camera, as a file says it.

    Args:
        name: of the image, as the file has it.
        values: by the keys of :class:`~clpipe.chain.render_camera.RenderCamera`.
        size: width and height in px; None where it does not say them.
        problem: why it can be no render's; "" where it can.
    """

    name: str
    values: Mapping[str, Any]
    size: tuple[int, int] | None = None
    problem: str = ""


def read_views(path: Path) -> list[View]:
    """The views of a file.

    Raises:
        RequestError: it cannot be read, is of none of the forms, or has no view.
    """
    if path.is_dir():
        views = list(_from_colmap(path))
        if not views:
            raise RequestError(f"--poses {path}: its images.txt has no image")
        return views
    text = read_named("--poses", path, MANIFEST_BYTES)
    try:
        values = parse_json(text)
    except ValueError as error:
        raise RequestError(
            f"--poses {path}: no valid JSON ({error}); it is a cameras.json, a transforms.json, or "
            "a folder with COLMAP's cameras.txt and images.txt"
        ) from None
    for key, parse in FORMS.items():
        listed = values.get(key) if isinstance(values, dict) else None
        if isinstance(listed, list) and listed:
            return [
                _parsed(path, number, each, values, parse) for number, each in enumerate(listed)
            ]
    raise RequestError(
        f"--poses {path}: has neither a list 'views', as a cameras.json, nor 'frames', as a "
        "transforms.json"
    )


Parser = Callable[[Mapping[str, Any], Mapping[str, Any]], View]


def _parsed(path: Path, number: int, record: Any, common: Mapping[str, Any], parse: Parser) -> View:
    """A view of a JSON.

    Raises:
        RequestError: it does not say what image it is of.
    """
    key = "file_path" if parse is _from_frame else "file"
    name = record.get(key) if isinstance(record, dict) else None
    if not isinstance(name, str) or not name:
        raise RequestError(f"--poses {path}: view {number + 1} has no '{key}', the image's name")
    try:
        return replace(parse(record, common), name=name)
    except ValueError as error:
        return View(name, {}, problem=str(error))


def _from_view(view: Mapping[str, Any], common: Mapping[str, Any]) -> View:
    """A view of a cameras.json.

    Raises:
        ValueError: a value is not allowed; the message says which.
    """
    own = {**common, **view}
    values: dict[str, Any] = {}
    if "K" in own:
        k = numbers("K", own["K"], (3, 3))
        if k[0, 1] or k[1, 0] or k[2].tolist() != [0, 0, 1]:
            raise ValueError(
                f"K: found {k.tolist()}, but it is [[fx, 0, cx], [0, fy, cy], [0, 0, 1]]"
            )
        values = dict(
            zip(("fx", "fy", "cx", "cy"), k[[0, 1, 0, 1], [0, 1, 2, 2]].tolist(), strict=True)
        )
    if ("R" in own) != ("t" in own):
        raise ValueError("R and t belong together, and one of them is missing")
    if "R" in own:
        values["rotation"] = numbers("R", own["R"], (3, 3)).tolist()
        values["translation"] = numbers("t", own["t"], (3,)).tolist()
    coefficients = own.get("distortion") or {}
    if not isinstance(coefficients, dict):
        raise ValueError(
            f"distortion: found {coefficients!r}, but it is coefficients by their names"
        )
    _check_pinhole(str(own.get("model") or "PINHOLE"), coefficients)
    return View("", values, _size(own, "width", "height"))


def _from_frame(frame: Mapping[str, Any], common: Mapping[str, Any]) -> View:
    """A frame of a transforms.json; what it does not say itself is that of all frames.

    Raises:
        ValueError: a value is not allowed; the message says which.
    """
    own = {**common, **frame}
    names = {"fl_x": "fx", "fl_y": "fy", "cx": "cx", "cy": "cy", "camera_angle_x": "camera_angle_x"}
    values: dict[str, Any] = {
        to: numbers(name, own[name], ()).item() for name, to in names.items() if name in own
    }
    if "transform_matrix" in own:
        shape = (3, 4) if np.shape(own["transform_matrix"])[:1] == (3,) else (4, 4)
        matrix = numbers("transform_matrix", own["transform_matrix"], shape)
        r, t = from_opengl(matrix)
        values |= {"rotation": r.tolist(), "translation": t.tolist()}
    coefficients = {name: value for name, value in own.items() if COEFFICIENT.fullmatch(name)}
    listed = numbers("distortion_params", own.get("distortion_params", []), None).tolist()
    coefficients |= {f"distortion_params[{i}]": value for i, value in enumerate(listed)}
    _check_pinhole(str(own.get("camera_model") or "PINHOLE"), coefficients)
    size = _size(own, "w", "h")
    if size and "fx" not in values and 0 < values.get("camera_angle_x", 0.0) < math.pi:
        values["fx"] = size[0] / 2 / math.tan(values.pop("camera_angle_x") / 2)
    return View("", values, size)


FORMS: dict[str, Parser] = {"views": _from_view, "frames": _from_frame}


def _from_colmap(folder: Path) -> Iterator[View]:
    """The images of COLMAP's text model, in a folder or in sparse/0 below it.

    Raises:
        RequestError: it cannot be read.
    """
    places = [
        place for place in (folder, folder / "sparse" / "0") if (place / "images.txt").exists()
    ]
    if not places:
        raise RequestError(
            f"--poses {folder}: has no images.txt, nor has its sparse/0; of a binary model, write "
            "the text: colmap model_converter --output_type TXT"
        )
    cameras = {}
    for line in _lines(places[0] / "cameras.txt"):
        if line and not line.startswith("#"):
            identity, *rest = line.split()
            cameras[identity] = rest
    lines = _lines(places[0] / "images.txt")
    for line in lines:
        if not line or line.startswith("#"):
            continue
        next(lines, "")  # the places of points in it
        _, *fields = line.split(maxsplit=9)
        if len(fields) != 9:
            raise RequestError(
                f"--poses {places[0] / 'images.txt'}: found the line {line[:80]!r}; expected "
                "IMAGE_ID QW QX QY QZ TX TY TZ CAMERA_ID NAME"
            )
        *numbers_, camera, name = fields
        try:
            yield _from_image(name, numbers_, cameras.get(camera, []))
        except ValueError as error:
            yield View(name, {}, problem=str(error))


def _lines(path: Path) -> Iterator[str]:
    try:
        text = read_named("--poses", path, MANIFEST_BYTES).decode("utf-8-sig")
    except UnicodeDecodeError:
        raise RequestError(f"--poses {path}: not a text in UTF-8") from None
    return iter([line.strip() for line in text.split("\n")])


def _from_image(name: str, pose: Sequence[str], camera: Sequence[str]) -> View:
    """An image of COLMAP's.

    Args:
        name: of the file.
        pose: quaternion and translation.
        camera: model, width, height and parameters, as in cameras.txt.

    Raises:
        ValueError: a value is not allowed; the message says which.
    """
    if len(camera) < 4:
        raise ValueError("it has no camera in cameras.txt")
    model, width, height, *texts = camera
    q, t = np.split(numbers("QW QX QY QZ TX TY TZ", [_number(text) for text in pose], (7,)), [4])
    if not q.any():
        raise ValueError("its quaternion is 0")
    names = FOCAL_LENGTHS.get(model, ())
    parameters = numbers("PARAMS", [_number(text) for text in texts], None).tolist()
    if names and len(parameters) < len(names):
        raise ValueError(
            f"its camera has {len(parameters)} parameters; {model} has {' '.join(names)}"
        )
    rest = {f"parameter {i + 1}": value for i, value in enumerate(parameters) if i >= len(names)}
    _check_pinhole(model, rest)
    values: dict[str, Any] = dict(zip(names, parameters, strict=False))
    if "f" in values:
        values = {"fx": values.pop("f"), **values}
    values |= {"rotation": from_quaternion(q.tolist()).tolist(), "translation": t.tolist()}
    return View(name, values, _size({"w": _number(width), "h": _number(height)}, "w", "h"))


def _number(text: str) -> Any:
    try:
        return float(text)
    except ValueError:
        return text


def numbers(name: str, value: Any, shape: tuple[int, ...] | None) -> Array:
    """A value as finite float64 of a shape, or of one axis where that is None.

    Raises:
        ValueError: it is something else; the message names it.
    """
    try:
        array = np.array(value, np.float64)
    except (TypeError, ValueError, OverflowError):
        array = np.full(1, np.nan)
    if (array.ndim != 1 if shape is None else array.shape != shape) or not np.isfinite(array).all():
        size = "numbers" if shape is None else " rows of ".join(map(str, shape)) + " numbers"
        found = repr(value)
        shown = f"{found[:200]}..." if len(found) > 200 else found
        raise ValueError(f"{name}: found {shown}, but it is {'a number' if shape == () else size}")
    return array


def _size(values: Mapping[str, Any], *names: str) -> tuple[int, int] | None:
    """Width and height by their names; None where they are missing.

    Raises:
        ValueError: they are no sizes.
    """
    if not set(names) <= values.keys():
        return None
    width, height = (numbers(name, values[name], ()).item() for name in names)
    if not (width == int(width) > 0 and height == int(height) > 0):
        raise ValueError(
            f"found {width:g}x{height:g} pixels, but a size is of whole numbers above 0"
        )
    return int(width), int(height)


def _check_pinhole(model: str, coefficients: Mapping[str, Any]) -> None:
    """See that a camera has no distortion, as a render has none.

    Raises:
        ValueError: it has.
    """
    bent = ", ".join(f"{k} {v}" for k, v in coefficients.items() if v)
    if bent or model not in FOCAL_LENGTHS:
        what = f"has distortion ({bent})" if bent else f"is of the model {model}"
        raise ValueError(
            f"its camera {what}, but a render is straight; take it out of the file, and have "
            "clpipe bend the picture: clpipe stages distortion"
        )
