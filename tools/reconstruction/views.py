"""The views of a scene, with their ground truth: cameras, depth, and the texture of each pixel.

The experiment reads a folder of views, and --render makes it. It contains cameras.json, in clpipe's
format, and an EXR of half floats for each view, with these channels:

- R, G, B: linear Rec. 709. The compression DWAA changes them by 0.3 %.
- Z: depth along the optical axis in m, rounded by at most 0.05 % (0.1 px of disparity).
- texture: a number of TEXTURES.

All cameras look in the same direction, so neighbours are rectified without resampling, which would
correlate their noise. The lenses are shifted so that points at the distance CONVERGENCE are at the
same pixel in all views.
"""

import json
import subprocess
import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
import OpenImageIO as oiio

from clpipe.base.types import Array, Doubles, Floats, Mask
from clpipe.scenes.blender import Renderer, Rendering

SCRIPT = Path(__file__).with_name("scene.py")
TEXTURES = {"strong": 1, "weak": 2, "none": 3}  # object numbers in SCRIPT
CAMERAS = "cameras.json"
CHANNELS = ("R", "G", "B", "Z", "texture")

COLUMNS, ROWS = 3, 2  # arrangement of the cameras
WIDTH, HEIGHT = 960, 640  # px
FOCAL_LENGTH = 1000.0  # px
BASELINE = 0.35  # m, between neighbours in a row and in a column
CENTRE = (0.0, -2.4, 0.95)  # m, centre of the cameras
CONVERGENCE = 3.4  # m
SAMPLES = 48  # light paths for each pixel; Blender removes their noise

DWAA = 12  # compression level; a third of the error of the default, 45

SAME = 0.01  # largest relative difference of two depths of the same point


class View(NamedTuple):
    """A view of a scene.

    Args:
        name: the file name without extension.
        k, r, t: (3, 3), (3, 3) and (3,); x_cam = R X + t in m by OpenCV's axes; K in px, the first
            pixel's centre at (0.5, 0.5).
        depth: (height, width), m along the optical axis.
        texture: (height, width), with values of :data:`TEXTURES`.
    """

    name: str
    k: Doubles
    r: Doubles
    t: Doubles
    depth: Floats
    texture: Array


def read_views(folder: Path) -> list[View]:
    """Read the views of a folder.

    Raises:
        ValueError: the folder has no views, or a file cannot be read. The message names it.
    """
    path = folder / CAMERAS
    try:
        records = json.loads(path.read_text(encoding="utf-8"))["views"]
        return [_read_view(folder, record) for record in records]
    except OSError as error:
        raise ValueError(
            f"{path}: {error.strerror}; choose a folder of views, or add --render"
        ) from None
    except (KeyError, TypeError, json.JSONDecodeError) as error:
        raise ValueError(f"{path}: expected cameras, found {error!r}") from None


def _read_view(folder: Path, record: dict) -> View:
    path = folder / record["file"]
    truth = read_layers(path, CHANNELS[3:])
    if truth.shape[0] % 2 or truth.shape[1] % 2:
        size = f"{truth.shape[1]}x{truth.shape[0]}"
        raise ValueError(f"{path}: found {size} px; expected even sizes")
    k, r, t = (np.array(record[key], np.float64) for key in "KRt")
    return View(path.stem, k, r, t, truth[..., 0], np.rint(truth[..., 1]).astype(np.uint8))


def read_layers(path: Path, names: tuple[str, ...]) -> Floats:
    """Read channels of an EXR from any of its parts, (height, width, channel) float32.

    Raises:
        ValueError: the file cannot be read, or lacks a channel.
    """
    file = oiio.ImageInput.open(str(path))
    if not file:
        raise ValueError(f"{path}: {oiio.geterror()}")
    found, part = {}, 0
    while file.seek_subimage(part, 0):
        spec = file.spec()
        pixels = file.read_image(part, 0, 0, spec.nchannels, oiio.FLOAT)
        if pixels is None:
            raise ValueError(f"{path}: {file.geterror()}")
        found |= dict(zip(spec.channelnames, np.moveaxis(pixels, 2, 0), strict=True))
        part += 1
    if missing := [name for name in names if name not in found]:
        raise ValueError(f"{path} has no channel {missing[0]}; it has {', '.join(found)}")
    return np.stack([found[name] for name in names], axis=2)


def write_view(path: Path, pixels: Floats) -> None:
    """Write :data:`CHANNELS`, (height, width, channel), as an EXR; DWAA changes only R, G and B.

    Raises:
        ValueError: the file cannot be written.
    """
    height, width = pixels.shape[:2]
    spec = oiio.ImageSpec(width, height, len(CHANNELS), oiio.HALF)
    spec.channelnames = CHANNELS
    spec.attribute("compression", f"dwaa:{DWAA}")
    spec.attribute("DateTime", "1970:01:01 00:00:00")  # for reproducible bytes
    file = oiio.ImageOutput.create(str(path))
    if not (file and file.open(str(path), spec) and file.write_image(pixels) and file.close()):
        raise ValueError(f"{path}: {file.geterror() if file else oiio.geterror()}")


def rig() -> list[dict]:
    """Return the cameras as records of cameras.json, row by row from the top left."""
    rotation = np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]])  # y is ahead, z up
    records = []
    for number in range(COLUMNS * ROWS):
        row, column = divmod(number, COLUMNS)
        right = (column - (COLUMNS - 1) / 2) * BASELINE
        down = (row - (ROWS - 1) / 2) * BASELINE
        shift = FOCAL_LENGTH / CONVERGENCE
        k = [
            [FOCAL_LENGTH, 0.0, WIDTH / 2 + shift * right],
            [0.0, FOCAL_LENGTH, HEIGHT / 2 + shift * down],
            [0.0, 0.0, 1.0],
        ]
        place = np.add(CENTRE, (right, 0, -down))
        pose = {"R": rotation.tolist(), "t": (-rotation @ place).tolist()}
        size = {"width": WIDTH, "height": HEIGHT}
        records.append(
            {"name": f"view{number}", "file": f"view{number}.exr", **size, "K": k} | pose
        )
    return records


def render_views(folder: Path, program: str) -> None:
    """Render the views into a folder.

    Args:
        folder: created if it is missing.
        program: Blender, or a Python with the package bpy.

    Raises:
        ClpipeError: Blender cannot render the views.
        ValueError: a view cannot be written.
    """
    records = rig()
    python = Path(program).name.startswith("python")
    command = [program, str(SCRIPT)] if python else [program, "-b", "-P", str(SCRIPT), "--"]
    folder.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory() as place:
        work = Path(place)
        make_scene([*command, place])
        for scene, samples in (("colour", SAMPLES), ("centres", 1)):
            (work / scene).mkdir()
            denoise = samples > 1
            rendering = Rendering(
                *(work / f"{scene}.blend", work / scene, {"cameras": records}),
                *(None, samples, None, denoise, 0),
            )
            with Renderer(rendering, program) as renderer:
                layers = renderer.scene().layers
                for name, seconds in renderer.rendered(len(records)):
                    print(f"rendered {scene} of {name}: {seconds:.0f} s", flush=True)
        depth, _, number = layers
        for record in records:
            colour = read_layers(
                work / "colour" / record["file"],
                tuple(f"ViewLayer.Combined.{channel}" for channel in "RGB"),
            )
            truth = read_layers(
                work / "centres" / record["file"],
                (f"ViewLayer.{depth}.Z", f"ViewLayer.{number}.X"),
            )
            write_view(folder / record["file"], np.concatenate([colour, truth], axis=2))
    kept = [{key: value for key, value in each.items() if key != "name"} for each in records]
    text = json.dumps({"views": kept}, indent=1)
    (folder / CAMERAS).write_text(f"{text}\n", encoding="utf-8")


def make_scene(command: Sequence[str]) -> None:
    """Run the command that makes the scene.

    Raises:
        ValueError: the command fails.
    """
    try:
        made = subprocess.run(command, capture_output=True, text=True, check=False)
    except OSError as error:
        raise ValueError(f"--render: {command[0]}: {error.strerror}") from None
    if made.returncode:
        last = (made.stderr or made.stdout).strip().splitlines()[-1:]
        raise ValueError(f"--render: {command[0]} failed to make the scene: {' '.join(last)}")


def projected(view: View, other: View) -> tuple[Doubles, Doubles]:
    """Project the centres of a view's pixels into another view.

    Returns:
        Positions in the other view, (height, width, 2), x and y in px, and depths in the other
        view, (height, width), in m.
    """
    height, width = view.depth.shape
    y, x = np.mgrid[:height, :width] + 0.5
    rays = np.stack([x, y, np.ones_like(x)], axis=2) @ np.linalg.inv(view.k).T
    world = (rays * view.depth[..., None] - view.t) @ view.r
    point = (world @ other.r.T + other.t) @ other.k.T
    return point[..., :2] / point[..., 2:], point[..., 2]


def visible(view: View, other: View) -> Mask:
    """Return the mask, (height, width), of a view's pixels that another view also sees."""
    places, depth = projected(view, other)
    column, row = np.moveaxis(np.floor(places).astype(np.intp), 2, 0)
    height, width = other.depth.shape
    inside = (column >= 0) & (column < width) & (row >= 0) & (row < height)
    found = other.depth[np.clip(row, 0, height - 1), np.clip(column, 0, width - 1)]
    return inside & (np.abs(found - depth) < SAME * depth)
