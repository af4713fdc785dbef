"""Formats cameras as cameras.json, COLMAP's text model and nerfstudio's transforms.json."""

from collections import defaultdict
from collections.abc import Mapping, Sequence
from itertools import count
from types import MappingProxyType
from typing import Any

from clpipe.base.about import FORMAT, FORMAT_KEY, __version__
from clpipe.outputs.output_pictures import OutputPicture, lens_record
from clpipe.outputs.sidecar import json_text
from clpipe.reference.intrinsics import COEFFICIENTS, OPENCV, OPENCV_FISHEYE, THIN_PRISM
from clpipe.reference.pose import to_opengl, to_quaternion

CAMERAS, TRANSFORMS, COLMAP = "cameras.json", "transforms.json", "sparse/0"

NOTE = (
    f"clpipe {__version__}: K in px, the first pixel's centre at (0.5, 0.5); "
    "x_cam = R X + t, OpenCV's axes; models and coefficients are COLMAP's"
)

PRISM = "not in {}, which has no model with a thin prism"

OPENGL_NOTE = (
    f"clpipe {__version__}: camera to world, OpenGL's axes; the first pixel's centre at (0.5, 0.5)"
)

# nerfstudio's k4 for OPENCV is the coefficient of r^8, which OpenCV's polynomial does not have.
NERFSTUDIO = {
    OPENCV: ("k1", "k2", "k3", "k4", "p1", "p2"),
    OPENCV_FISHEYE: ("k1", "k2", "k3", "k4"),
}


class Responses:
    """The response curves (light to code values) of a file's pictures, without duplicates."""

    def __init__(self) -> None:
        self._curves: list[Any] = []

    def record_for(self, picture: OutputPicture) -> dict[str, Any]:
        """Return a picture's photometry, with its response as an index into the list of curves."""
        if picture.photometry is None:
            return {}
        if (curve := picture.photometry.get("response")) is None:
            return {"photometry": {**picture.photometry}}
        if curve not in self._curves:
            self._curves.append(curve)
        return {"photometry": {**picture.photometry, "response": self._curves.index(curve)}}

    @property
    def record(self) -> dict[str, Any]:
        """The list of curves, as JSON values; {} if it is empty."""
        return {"responses": self._curves} if self._curves else {}


def cameras_json(pictures: Sequence[OutputPicture], prefix: str = "") -> str:
    """Return the text of a cameras.json, which ``--poses`` also reads.

    Args:
        pictures: the pictures.
        prefix: the relative path from the file's folder to the pictures' folder.
    """
    views, responses = [], Responses()
    for each in pictures:
        camera = each.camera
        k = [[camera.fx, 0.0, camera.cx], [0.0, camera.fy, camera.cy], [0.0, 0.0, 1.0]]
        view = {"file": prefix + each.file, "width": camera.width, "height": camera.height, "K": k}
        view |= dict(zip("Rt", each.pose, strict=True)) if each.pose else {}
        view |= lens_record(camera)
        view |= {"motion": each.motion} if each.motion else {}
        views.append(view | responses.record_for(each))
    return json_text({FORMAT_KEY: FORMAT, "note": NOTE, **responses.record, "views": views})


def colmap(
    pictures: Sequence[OutputPicture],
    posed: Sequence[OutputPicture],
    skipped: Mapping[str, list[str]],
) -> dict[str, str]:
    """Return the files of COLMAP's text model by path, or only the cameras if no pose is known.

    See https://colmap.github.io/format.html. Pictures with the same camera share its entry.

    Args:
        pictures: all pictures.
        posed: the pictures whose pose is known.
        skipped: receives the names of pictures that the format cannot hold, by reason.
    """
    numbers: dict[str, int] = defaultdict(count(1).__next__)
    camera_ids = {}
    for each in pictures:
        camera, names = each.camera, COEFFICIENTS[each.camera.model]
        if camera.model == THIN_PRISM:
            skipped[PRISM.format(COLMAP)].append(each.file)
            continue
        values = [camera.fx, camera.fy, camera.cx, camera.cy]
        values += [camera.distortion[name] for name in names]
        size = f"{camera.width} {camera.height}"
        camera_ids[each.file] = numbers[f"{camera.model} {size} {_text(values)}"]
    if not camera_ids:
        return {}
    cameras = [f"{number} {text}" for text, number in numbers.items()]
    files = {"cameras.txt": ("CAMERA_ID MODEL WIDTH HEIGHT PARAMS", cameras)}
    if posed:
        images = []
        for number, each in enumerate(posed, 1):
            if each.file not in camera_ids:
                continue
            if any(letter.isspace() for letter in each.file):
                reason = "not in images.txt, which allows no spaces in names"
                skipped[reason].append(each.file)
                continue
            assert each.pose
            r, t = each.pose
            frame = f"{number} {_text([*to_quaternion(r), *t])}"
            images.append(f"{frame} {camera_ids[each.file]} {each.file}\n")
        files["images.txt"] = ("IMAGE_ID QW QX QY QZ TX TY TZ CAMERA_ID NAME, and points", images)
        files["points3D.txt"] = ("none", [])
    return {
        f"{COLMAP}/{name}": "\n".join([f"# clpipe {__version__}: {what}", *lines, ""])
        for name, (what, lines) in files.items()
    }


def _text(values: Sequence[float]) -> str:
    return " ".join(repr(float(value)) for value in values)


def _rows_of(picture: OutputPicture) -> dict[str, Any]:
    """Return a moving camera's poses at the first and last row, camera to world, and the times."""
    motion = picture.motion
    if not motion:
        return {}
    rows = {
        f"transform_matrix_{name}": to_opengl(motion[name]["R"], motion[name]["t"]).tolist()
        for name in ("first_row", "last_row")
    }
    times = {"exposure_time": motion["exposure_time"]}
    return {**rows, **times, "rolling_shutter_time": motion["readout_time"]}


def nerfstudio(
    pictures: Sequence[OutputPicture],
    prefix: str,
    skipped: Mapping[str, list[str]],
    splits: Mapping[str, str] = MappingProxyType({}),
) -> str:
    """Return the text of a nerfstudio transforms.json, or "" if it cannot contain any picture.

    See https://docs.nerf.studio/quickstart/data_conventions.html. Pixel coordinates are those of
    COLMAP. All pictures must have one camera model, so fisheye pictures are skipped if there are
    others. A camera that all pictures share is written at the top level, where other readers expect
    it.

    Args:
        pictures: the pictures whose pose is known.
        prefix: the relative path from the file's folder to the pictures' folder.
        skipped: receives the names of pictures that the format cannot hold, by reason.
        splits: "train", "val" or "test" for each picture, by its name in sidecars.
    """
    prisms = [each.file for each in pictures if each.camera.model == THIN_PRISM]
    if prisms:
        skipped[PRISM.format(TRANSFORMS)] += prisms
        pictures = [each for each in pictures if each.file not in prisms]
    fisheyes = [each for each in pictures if each.camera.model == OPENCV_FISHEYE]
    is_fisheye = len(fisheyes) == len(pictures)
    model = OPENCV_FISHEYE if is_fisheye else OPENCV
    cameras, frames, responses = [], [], Responses()
    for each in pictures:
        if (each.camera.model == OPENCV_FISHEYE) != is_fisheye:
            reason = f"not in {TRANSFORMS}, which allows no fisheyes together with other lenses"
            skipped[reason].append(each.file)
            continue
        assert each.pose
        camera = each.camera if is_fisheye else each.camera.polynomial()
        sizes = {"w": camera.width, "h": camera.height, "fl_x": camera.fx, "fl_y": camera.fy}
        coefficients = {name: camera.distortion.get(name, 0.0) for name in NERFSTUDIO[model]}
        residual = {"distortion_residual": camera.residual} if camera.residual else {}
        cameras.append({**sizes, "cx": camera.cx, "cy": camera.cy, **coefficients, **residual})
        frame: dict[str, Any] = {"file_path": prefix + each.file}
        frame |= {"depth_file_path": prefix + each.depth} if each.depth else {}
        frame["transform_matrix"] = to_opengl(*each.pose).tolist()
        frames.append(frame | _rows_of(each) | responses.record_for(each))
    if not frames:
        return ""
    shared = cameras[0] if all(each == cameras[0] for each in cameras) else {}
    if not shared:
        frames = [{**frame, **camera} for frame, camera in zip(frames, cameras, strict=True)]
    of_split = {
        split: [prefix + each.file for each in pictures if splits.get(each.name) == split]
        for split in dict.fromkeys(splits.values())
    }
    if "val" in of_split:  # nerfstudio needs all three lists if there is any list
        of_split.setdefault("test", of_split["val"])
    lists = {f"{split}_filenames": files for split, files in of_split.items()}
    header = {"note": OPENGL_NOTE, "camera_model": model, **shared, **responses.record, **lists}
    return json_text({**header, "frames": frames})
