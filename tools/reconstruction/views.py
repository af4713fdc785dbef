"""The views of a scene, with what is true of them: cameras, depth, and the texture of each pixel.

A folder of views is what the experiment reads and --render makes: cameras.json, as clpipe
writes it, and an EXR of half floats for each view: R, G and B (linear Rec. 709; DWAA bends them by
0.3 %), Z (depth along the optical axis in m, rounded by 0.05 % at most, which is 0.1 px of
disparity) and texture (a number of TEXTURES).

The cameras stand side by side and look the same way, so neighbours are rectified as they are, and
nothing has to be resampled, which would correlate their noise. Their lenses are shifted: what is
CONVERGENCE away is at the same pixel in all.
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
TEXTURES = {"strong": 1, "weak": 2, "none": 3}  # as SCRIPT numbers its objects
CAMERAS = "cameras.json"
CHANNELS = ("R", "G", "B", "Z", "texture")

COLUMNS, ROWS = 3, 2  # of cameras
WIDTH, HEIGHT = 960, 640  # px
FOCAL_LENGTH = 1000.0  # px
BASELINE = 0.35  # m, between neighbours in a row and in a column
CENTRE = (0.0, -2.4, 0.95)  # m, of the cameras
CONVERGENCE = 3.4  # m
SAMPLES = 48  # light paths for each pixel; what noise they leave is denoised

DWAA = 12  # the level; a third of the damage of the usual 45

SAME = 0.01  # two depths are those of one place where they differ by less than so many of them


class View(NamedTuple):
    """A view of a scene.

    Args:
        name: of its file, without ending.
        k, r, t: (3, 3), (3, 3) and (3,); x_cam = R X + t in m by OpenCV's axes; K in px, the first
            pixel's centre at (0.5, 0.5).
        depth: (height, width), m along the optical axis.
        texture: (height, width), of the values of :data:`TEXTURES`.
    """

    name: str
    k: Doubles
    r: Doubles
    t: Doubles
    depth: Floats
    texture: Array


def read_views(folder: Path) -> list[View]:
    """The views of a folder.

    Raises:
        ValueError: it holds none, or a file of them cannot be read; the message names it.
    """
    path = folder / CAMERAS
    try:
        records = json.loads(path.read_text(encoding="utf-8"))["views"]
        return [_read_view(folder, record) for record in records]
    except OSError as error:
        raise ValueError(f"{path}: {error.strerror}; name a folder of views, or --render") from None
    except (KeyError, TypeError, json.JSONDecodeError) as error:
        raise ValueError(f"{path}: expected the cameras of views, found {error!r}") from None


def _read_view(folder: Path, record: dict) -> View:
    path = folder / record["file"]
    truth = read_layers(path, CHANNELS[3:])
    if truth.shape[0] % 2 or truth.shape[1] % 2:
        size = f"{truth.shape[1]}x{truth.shape[0]}"
        raise ValueError(f"{path}: found {size} px; expected even sizes, which can be halved")
    k, r, t = (np.array(record[key], np.float64) for key in "KRt")
    return View(path.stem, k, r, t, truth[..., 0], np.rint(truth[..., 1]).astype(np.uint8))


def read_layers(path: Path, names: tuple[str, ...]) -> Floats:
    """Channels of an EXR, of whichever part, (height, width, channel) float32.

    Raises:
        ValueError: it cannot be read, or lacks one.
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
        raise ValueError(f"{path}: has no channel {missing[0]}, but {', '.join(found)}")
    return np.stack([found[name] for name in names], axis=2)


def write_view(path: Path, pixels: Floats) -> None:
    """Write :data:`CHANNELS`, (height, width, channel), as an EXR; DWAA bends R, G and B alone.

    Raises:
        ValueError: it cannot be written.
    """
    height, width = pixels.shape[:2]
    spec = oiio.ImageSpec(width, height, len(CHANNELS), oiio.HALF)
    spec.channelnames = CHANNELS
    spec.attribute("compression", f"dwaa:{DWAA}")
    spec.attribute("DateTime", "1970:01:01 00:00:00")  # the same bytes each time
    file = oiio.ImageOutput.create(str(path))
    if not (file and file.open(str(path), spec) and file.write_image(pixels) and file.close()):
        raise ValueError(f"{path}: {file.geterror() if file else oiio.geterror()}")


def rig() -> list[dict]:
    """The cameras as records of a cameras.json, row by row from the top left."""
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
        folder: it is made where it is missing.
        program: a Blender, or a Python that has the package bpy.

    Raises:
        ClpipeError: Blender cannot render them.
        ValueError: one cannot be written.
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
            asked = Rendering(
                *(work / f"{scene}.blend", work / scene, {"cameras": records}),
                *(None, samples, None, denoise, 0),
            )
            with Renderer(asked, program) as renderer:
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
        ValueError: it fails.
    """
    try:
        made = subprocess.run(command, capture_output=True, text=True, check=False)
    except OSError as error:
        raise ValueError(f"--render: {command[0]}: {error.strerror}") from None
    if made.returncode:
        last = (made.stderr or made.stdout).strip().splitlines()[-1:]
        raise ValueError(f"--render: {command[0]} failed to make the scene: {' '.join(last)}")


def seen_from(view: View, other: View) -> tuple[Doubles, Doubles]:
    """Where another camera sees what is at the centres of a view's pixels.

    Returns:
        Its places in the other picture, (height, width, 2), x and y in px, and its depth there,
        (height, width) in m.
    """
    height, width = view.depth.shape
    y, x = np.mgrid[:height, :width] + 0.5
    rays = np.stack([x, y, np.ones_like(x)], axis=2) @ np.linalg.inv(view.k).T
    world = (rays * view.depth[..., None] - view.t) @ view.r
    there = (world @ other.r.T + other.t) @ other.k.T
    return there[..., :2] / there[..., 2:], there[..., 2]


def visible(view: View, other: View) -> Mask:
    """Which of a view's pixels another sees, too, by the depth of both, (height, width)."""
    places, depth = seen_from(view, other)
    column, row = np.moveaxis(np.floor(places).astype(np.intp), 2, 0)
    height, width = other.depth.shape
    inside = (column >= 0) & (column < width) & (row >= 0) & (row < height)
    found = other.depth[np.clip(row, 0, height - 1), np.clip(column, 0, width - 1)]
    return inside & (np.abs(found - depth) < SAME * depth)
