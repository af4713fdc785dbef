"""The views of an output folder, from its sidecars: cameras.json, COLMAP's text model and
nerfstudio's transforms.json.

The pictures are sorted by their names, so the same sidecars make the same bytes in any order.
"""

import os
from collections import defaultdict
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import count
from pathlib import Path
from typing import Any

from pydantic import TypeAdapter

from clpipe.base.about import __version__
from clpipe.base.errors import ImageError
from clpipe.base.files import keep_names, make_folder_of, write_whole
from clpipe.base.reading import read_bytes
from clpipe.chain.formats import DNG, ending_of
from clpipe.chain.render_camera import Matrix, Vector
from clpipe.chain.rendition import BASELINES, NOISY, PICTURES, Rendition, Role
from clpipe.outputs.existing import is_marked
from clpipe.outputs.sealed import (
    SIDECAR,
    SidecarError,
    is_sidecar,
    json_text,
    outputs_in,
    values_in,
)
from clpipe.reference.intrinsics import COEFFICIENTS, OPENCV, OPENCV_FISHEYE, PINHOLE, Intrinsics
from clpipe.reference.pose import to_opengl, to_quaternion

CAMERAS, TRANSFORMS, COLMAP = "cameras.json", "transforms.json", "sparse/0"

# What is trained on is of one kind: noisy pictures lie in the folder itself, others below.
OTHERS = (*PICTURES, *BASELINES)
MODELS = {NOISY: "", **{role: f"models/{Rendition(role).label[1:]}/" for role in OTHERS}}

FILES = tuple(
    model + name
    for model in MODELS.values()
    for name in (
        *(CAMERAS, TRANSFORMS),
        *(f"{COLMAP}/cameras.txt", f"{COLMAP}/images.txt", f"{COLMAP}/points3D.txt"),
    )
)

NOTE = (
    f"clpipe {__version__}: K in px, the first pixel's centre at (0.5, 0.5); "
    "x_cam = R X + t, OpenCV's axes; models and coefficients are COLMAP's"
)

OPENGL_NOTE = (
    f"clpipe {__version__}: camera to world, OpenGL's axes; the first pixel's centre at (0.5, 0.5)"
)

CHANGED = "a sidecar that was changed since clpipe wrote it"

CAMERA = TypeAdapter(Intrinsics)
POSE: TypeAdapter[tuple[Matrix, Vector]] = TypeAdapter(tuple[Matrix, Vector])

NERFSTUDIO = {OPENCV: ("k1", "k2", "k3", "p1", "p2"), OPENCV_FISHEYE: ("k1", "k2", "k3", "k4")}


@dataclass(frozen=True)
class Photograph:
    """A picture of an output folder.

    Args:
        file: its path there.
        role: what it is.
        camera: its intrinsics.
        pose: R and t, where known.
        photometry: see :func:`clpipe.chain.photometry.photometry_of`.
        motion: see :func:`clpipe.outputs.motion.motion_records`.
    """

    file: str
    role: Role
    camera: Intrinsics
    pose: tuple[Matrix, Vector] | None
    photometry: Mapping[str, Any] | None = None
    motion: Mapping[str, Any] | None = None


@dataclass(frozen=True)
class Written:
    """What was written of a folder's views.

    Args:
        files: by their paths in the folder; none where no picture's intrinsics are known.
        pictures: how many are in them.
        left_out: what is not in all of them and why, as texts.
    """

    files: tuple[str, ...]
    pictures: int
    left_out: tuple[str, ...]

    def lines(self, folder: Path) -> list[str]:
        """The same for people; ``folder`` is the one that it was written to."""
        warnings = [f"warning: {each}" for each in self.left_out]
        if not self.files:
            return warnings
        shown = dict.fromkeys("/".join(name.split("/")[:2]) for name in self.files)
        files = ", ".join(str(folder / name) for name in shown)
        return [f"wrote {files}: {self.pictures} picture{'s' * (self.pictures != 1)}", *warnings]


def check_camera_files(folder: Path) -> None:
    """See that the files of a folder's views may be written.

    Raises:
        ImageError: one of their names is somebody else's.
    """
    for path in (folder / name for name in FILES):
        if os.path.lexists(path) and not (is_marked(path) or _is_taken(path)):
            raise ImageError(
                f"{path}: clpipe did not write this file, and would overwrite it with the cameras "
                "of this folder's pictures; move it, or choose another output folder"
            )


def write_camera_files(folder: Path) -> Written:
    """Write the views of an output folder, as its sidecars say them.

    Raises:
        ImageError: a file cannot be written or is somebody else's.
    """
    check_camera_files(folder)
    left_out: dict[str, list[str]] = defaultdict(list)
    found = sorted(photographs(folder, left_out), key=lambda each: each.file)
    texts: dict[str, str] = {}
    for role, model in MODELS.items():
        own = [each for each in found if each.role == role]
        texts |= {model + name: text for name, text in texts_of(own, model, left_out).items()}
    taken = [name for name in texts if _is_taken(folder / name)]
    for name in taken:
        del texts[name]
    for name in FILES:
        path = folder / name
        if _is_taken(path):
            continue
        if name in texts:
            make_folder_of(path)
            write_whole(path, texts[name].encode())
            keep_names(path.parent)
        elif texts:
            path.unlink(missing_ok=True)  # of pictures that have gone
    reasons = tuple(
        f"{why}: {len(files)} picture{'s' * (len(files) > 1)}, such as {min(files)}"
        for why, files in left_out.items()
        if files
    )
    reasons += tuple(
        f"{folder / name} is the sidecar of a picture, so the cameras are not written there; give "
        "that image another name"
        for name in taken
    )
    return Written(tuple(name for name in FILES if name in texts), len(found), reasons)


def texts_of(
    pictures: Sequence[Photograph], model: str, left_out: Mapping[str, list[str]]
) -> dict[str, str]:
    """The files of pictures of one kind, by their names.

    Args:
        pictures: sorted.
        model: the folder that the files are for, below the pictures' own.
        left_out: gets the names of those that are not in all of them, by the reason.
    """
    if not pictures:
        return {}
    up = "../" * model.count("/")
    posed = [each for each in pictures if each.pose]
    if posed:
        left_out[f"no pose, so not in {TRANSFORMS} and images.txt"] += [
            each.file for each in pictures if not each.pose
        ]
    texts = {CAMERAS: cameras_json(pictures, up), **colmap(pictures, posed, left_out)}
    if nerf := nerfstudio(posed, up, left_out):
        texts[TRANSFORMS] = nerf
    return texts


def _is_taken(path: Path) -> bool:
    """Whether a file of the views would take the place of a picture's sidecar."""
    try:
        return is_sidecar(read_bytes(path))
    except OSError:
        return False


def photographs(folder: Path, left_out: Mapping[str, list[str]]) -> Iterator[Photograph]:
    """The pictures that sidecars of a folder list, in the first format that is no raw.

    Frames of bursts and exposures of brackets are among them; mosaics are not.

    Args:
        folder: the output folder.
        left_out: gets the names of those whose camera is not known, by the reason.

    """
    for place, folders, names in os.walk(folder):
        folders[:] = [name for name in folders if not name.startswith(".")]
        for name in names:
            path = Path(place, name)
            if not name.endswith(f".{SIDECAR}") or name.startswith("."):
                continue
            shown = path.relative_to(folder).as_posix()
            try:
                values = values_in(read_bytes(path), path)
                role = values and Rendition.from_record(values).role
                file = values and _picture(path, values) if role in MODELS else None
                if not values or not role or not file:
                    continue
                shown = file.relative_to(folder).as_posix()
                if values["intrinsics"] is None:
                    left_out["no known intrinsics, so in none of the files"].append(shown)
                    continue
                camera = CAMERA.validate_python(values["intrinsics"])
                pose = values["pose"]
                r_and_t = pose and POSE.validate_python((pose["R"], pose["t"]))
                told = values["photometry"], values.get("motion")
                yield Photograph(shown, role, simplest(camera), r_and_t, *told)
            except SidecarError:
                left_out[f"{CHANGED}, so not used; the same clpipe run makes it again"].append(
                    shown
                )
            except OSError:  # nor does a run take it for a sidecar
                continue
            except (KeyError, TypeError, ValueError):
                left_out["a sidecar that is damaged or of another version"].append(shown)


def _picture(sidecar: Path, values: Mapping[str, Any]) -> Path | None:
    """The picture of a sidecar; None where there is none.

    Raises:
        KeyError, TypeError, ValueError: the values are damaged.
    """
    formats = [each for each in values["request"]["formats"] if each != DNG]
    if not formats:
        return None
    file = sidecar.with_name(f"{sidecar.name.removesuffix(SIDECAR)}{ending_of(formats[0])}")
    return file if file.name in outputs_in(values) and file.exists() else None


def simplest(camera: Intrinsics) -> Intrinsics:
    """The same camera by the simplest of COLMAP's models that holds it.

    Raises:
        KeyError: there is no such model.

    >>> camera = Intrinsics(4, 3, 5, 5, 2, 1.5, "FULL_OPENCV", {"k1": 0.1, "k2": 0.0, "k4": 0.0})
    >>> simplest(camera).model, simplest(camera).distortion["k1"]
    ('OPENCV', 0.1)
    """
    bent = {name for name, value in camera.distortion.items() if value}
    simple = () if camera.model == OPENCV_FISHEYE else (PINHOLE, OPENCV)
    model = next((each for each in simple if bent <= {*COEFFICIENTS[each]}), camera.model)
    own = {name: camera.distortion.get(name, 0.0) for name in COEFFICIENTS[model]}
    return replace(camera, model=model, distortion=own)


class Responses:
    """The curves from light to codes of a file's pictures, each once."""

    def __init__(self) -> None:
        self._curves: list[Any] = []

    def of(self, picture: Photograph) -> dict[str, Any]:
        """What a file says of a picture's light; its response is the number of one of the list."""
        if picture.photometry is None:
            return {}
        curve = picture.photometry["response"]
        if curve not in self._curves:
            self._curves.append(curve)
        return {"photometry": {**picture.photometry, "response": self._curves.index(curve)}}

    @property
    def record(self) -> dict[str, Any]:
        """The list, as JSON values; nothing where there is none."""
        return {"responses": self._curves} if self._curves else {}


def cameras_json(pictures: Sequence[Photograph], up: str = "") -> str:
    """A cameras.json, which ``--poses`` reads, too; ``up`` leads to the pictures' folder."""
    views, responses = [], Responses()
    for each in pictures:
        camera = each.camera
        k = [[camera.fx, 0.0, camera.cx], [0.0, camera.fy, camera.cy], [0.0, 0.0, 1.0]]
        view = {"file": up + each.file, "width": camera.width, "height": camera.height, "K": k}
        view |= dict(zip("Rt", each.pose, strict=True)) if each.pose else {}
        view |= {"model": camera.model, "distortion": dict(camera.distortion)}
        view |= {"motion": each.motion} if each.motion else {}
        views.append(view | responses.of(each))
    return json_text({"note": NOTE, **responses.record, "views": views})


def colmap(
    pictures: Sequence[Photograph],
    posed: Sequence[Photograph],
    left_out: Mapping[str, list[str]],
) -> dict[str, str]:
    """COLMAP's text model by the paths of its files; only the cameras where no pose is known.

    https://colmap.github.io/format.html. Pictures with the same camera share it.

    Args:
        pictures: all.
        posed: those whose pose is known.
        left_out: gets the names that the format cannot hold, by the reason.
    """
    numbers: dict[str, int] = defaultdict(count(1).__next__)
    of_file = {}
    for each in pictures:
        camera, names = each.camera, COEFFICIENTS[each.camera.model]
        values = [camera.fx, camera.fy, camera.cx, camera.cy]
        values += [camera.distortion[name] for name in names]
        size = f"{camera.width} {camera.height}"
        of_file[each.file] = numbers[f"{camera.model} {size} {_text(values)}"]
    cameras = [f"{number} {text}" for text, number in numbers.items()]
    files = {"cameras.txt": ("CAMERA_ID MODEL WIDTH HEIGHT PARAMS", cameras)}
    if posed:
        images = []
        for number, each in enumerate(posed, 1):
            if any(letter.isspace() for letter in each.file):
                why = "a blank in the name, which images.txt cannot hold"
                left_out[why].append(each.file)
                continue
            assert each.pose
            r, t = each.pose
            placed = f"{number} {_text([*to_quaternion(r), *t])}"
            images.append(f"{placed} {of_file[each.file]} {each.file}\n")
        files["images.txt"] = ("IMAGE_ID QW QX QY QZ TX TY TZ CAMERA_ID NAME, and points", images)
        files["points3D.txt"] = ("none", [])
    return {
        f"{COLMAP}/{name}": "\n".join([f"# clpipe {__version__}: {what}", *lines, ""])
        for name, (what, lines) in files.items()
    }


def _text(values: Sequence[float]) -> str:
    return " ".join(repr(float(value)) for value in values)


def _rows_of(picture: Photograph) -> dict[str, Any]:
    """A moving camera's poses at the first and last row, camera to world, and the times."""
    motion = picture.motion
    if not motion:
        return {}
    rows = {
        f"transform_matrix_{name}": to_opengl(motion[name]["R"], motion[name]["t"]).tolist()
        for name in ("first_row", "last_row")
    }
    times = {"exposure_time": motion["exposure_time"]}
    return {**rows, **times, "rolling_shutter_time": motion["readout_time"]}


def nerfstudio(pictures: Sequence[Photograph], up: str, left_out: Mapping[str, list[str]]) -> str:
    """A transforms.json of nerfstudio's; "" where no picture can be in it.

    https://docs.nerf.studio/quickstart/data_conventions.html. It counts pixels as COLMAP does. Its
    k4 is none of OpenCV's, and all pictures are of one model: of more than one, fisheye pictures
    are left out. A camera that all share stands above the frames, where other readers look for it.

    Args:
        pictures: those whose pose is known.
        up: the way from the file's folder to the pictures'.
        left_out: gets the names that the format cannot hold, by the reason.
    """
    fisheyes = [each for each in pictures if each.camera.model == OPENCV_FISHEYE]
    is_fisheye = len(fisheyes) == len(pictures)
    model = OPENCV_FISHEYE if is_fisheye else OPENCV
    cameras, frames, responses = [], [], Responses()
    for each in pictures:
        camera = each.camera
        bent = {name for name, value in camera.distortion.items() if value}
        if (camera.model == OPENCV_FISHEYE) != is_fisheye or not bent <= {*NERFSTUDIO[model]}:
            left_out[f"a lens that {TRANSFORMS} cannot hold"].append(each.file)
            continue
        assert each.pose
        sizes = {"w": camera.width, "h": camera.height, "fl_x": camera.fx, "fl_y": camera.fy}
        own = {name: camera.distortion.get(name, 0.0) for name in NERFSTUDIO[model]}
        cameras.append({**sizes, "cx": camera.cx, "cy": camera.cy, **own})
        placed = {"file_path": up + each.file, "transform_matrix": to_opengl(*each.pose).tolist()}
        frames.append(placed | _rows_of(each) | responses.of(each))
    if not frames:
        return ""
    shared = cameras[0] if all(each == cameras[0] for each in cameras) else {}
    if not shared:
        frames = [{**frame, **camera} for frame, camera in zip(frames, cameras, strict=True)]
    said = {"note": OPENGL_NOTE, "camera_model": model, **shared, **responses.record}
    return json_text({**said, "frames": frames})
