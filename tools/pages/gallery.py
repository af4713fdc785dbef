"""Make the pictures of the documentation's first page: cameras and ISOs, and ground truth.

    tools/run pages gallery

It writes docs/gallery_cameras.webp and docs/gallery_truths.webp. Their cells are results of the
commands above them in docs/index.md. The tool first adds a layer of object numbers to the render.
"""

import json
from pathlib import Path
from tempfile import TemporaryDirectory

import matplotlib
import numpy as np
import OpenImageIO as oiio
from PIL import Image

import clpipe
from clpipe.base.types import Array
from tools import RENDER, ROOT
from tools.shared.options import parser_of
from tools.shared.pictures import enlarged, sheet

CAMERAS = ("sony-a7s2", "canon-6d", "nikon-d800", "oppo-reno-10x")
ISOS = (100, 1600, 6400)
CROP = (560, 292, 120, 96)  # x, y, width, height, with smooth places, edges and a dark corner
SCENES = ROOT / "tools" / "reconstruction" / "data"
# x, y and radius, in m, of the objects that tools/reconstruction/scene.py adds.
OBJECTS = (
    (-1.1, 0.1, 0.55),
    (-0.45, 0.55, 0.32),
    (0.1, -0.1, 0.42),
    (0.45, 0.6, 0.29),
    (1.2, 0.25, 0.43),
)
WALL, FLOOR = len(OBJECTS), len(OBJECTS) + 1  # their numbers
SCALE = 2
LENS = {"method": "brown_conrady", "fx": 900, "k1": 0.12}


def cameras(folder: Path) -> Image.Image:
    """Return a crop of a render for several cameras and ISOs."""
    made = clpipe.run(RENDER, folder, camera=CAMERAS, iso=ISOS, format="png")
    list(made)
    left, top, width, height = CROP
    rows = []
    for iso in ISOS:
        row = []
        for camera in CAMERAS:
            picture = Image.open(folder / camera / f"iso{iso}" / f"{RENDER.stem}.png")
            crop = np.asarray(picture.crop((left, top, left + width, top + height)))
            row.append((camera if iso == ISOS[0] else "", enlarged(crop, SCALE)))
        rows.append(row)
    return sheet(rows, [f"ISO {iso}" for iso in ISOS])


def truths(folder: Path) -> Image.Image:
    """Return a view of a scene with its ground truth."""
    options = {"truth": ["clean", "variance"], "carry": ["Z:depth", "object:label"]}
    scene = with_objects(folder)
    list(clpipe.run(scene, folder, format="png", iso=3200, distortion=LENS, **options))
    name = scene.stem
    pictures = {
        f"{name}.png": Image.open(folder / f"{name}.png"),
        "truth_clean.png": Image.open(folder / f"{name}.truth_clean.png"),
        "truth_variance.exr": coloured(np.sqrt(layer(folder / f"{name}.truth_variance.exr", 0))),
    }
    carried = folder / f"{name}.carried.exr"
    names = oiio.ImageBuf(str(carried)).spec().channelnames
    depth, label = (next(i for i, n in enumerate(names) if key in n) for key in ("Z", "object"))
    pictures["carried.exr: depth"] = coloured(-layer(carried, depth))
    pictures["carried.exr: objects"] = coloured(layer(carried, label), "tab20")
    size = (240, 160)
    boxed = Image.Resampling.BOX
    small = {name: i.convert("RGB").resize(size, boxed) for name, i in pictures.items()}
    return sheet([[(name, np.asarray(picture)) for name, picture in small.items()]])


def with_objects(folder: Path) -> Path:
    """Write a view with a layer "object", the object number of each pixel, from its depth."""
    view = json.loads((SCENES / "cameras.json").read_text("utf-8"))["views"][0]
    render = oiio.ImageBuf(str(SCENES / view["file"]))
    depth = layer(SCENES / view["file"], render.spec().channelnames.index("Z"))
    (height, width), k = depth.shape, np.array(view["K"])
    v, u = np.mgrid[:height, :width] + 0.5
    rays = np.stack([u, v, np.ones_like(u)], -1) @ np.linalg.inv(k).T
    points = (rays * depth[..., None] - view["t"]) @ np.array(view["R"])  # in the world
    centres, radii = np.array(OBJECTS)[:, :2], np.array(OBJECTS)[:, 2]
    distances = np.linalg.norm(points[..., None, :2] - centres, axis=-1) / radii
    numbers = np.where(points[..., 2] < 0.01, FLOOR, distances.argmin(-1))
    numbers = np.where(points[..., 1] > 1.19, WALL, numbers)
    samples = np.dstack([*(layer(SCENES / view["file"], i) for i in range(4)), numbers])
    spec = oiio.ImageSpec(width, height, 5, oiio.FLOAT)
    spec.channelnames = ("R", "G", "B", "Z", "object")
    written = oiio.ImageBuf(spec)
    written.set_pixels(oiio.ROI(), np.ascontiguousarray(samples, np.float32))
    path = folder.with_name(view["file"])
    written.write(str(path))
    return path


def layer(path: Path, channel: int) -> Array:
    """Return a channel of a file, (height, width)."""
    pixels = oiio.ImageBuf(str(path)).get_pixels(oiio.FLOAT)
    return np.asarray(pixels).reshape(*pixels.shape[:2], -1)[..., channel]


def coloured(values: Array, colours: str = "viridis") -> Image.Image:
    """Return values as colours. The scale excludes the lowest and the highest 1 %."""
    low, high = np.percentile(values[np.isfinite(values)], (1, 99))
    scaled = np.clip((values - low) / max(high - low, 1e-9), 0, 1)
    pixels = matplotlib.colormaps[colours](np.nan_to_num(scaled))[..., :3]
    return Image.fromarray((pixels * 255).astype(np.uint8))


def main() -> None:
    """Write the pictures."""
    parser_of(__doc__).parse_args()
    with TemporaryDirectory() as name:
        for stem, make in (("cameras", cameras), ("truths", truths)):
            path = ROOT / "docs" / f"gallery_{stem}.webp"
            make(Path(name, stem)).save(path, quality=88, method=6)
            print(path.relative_to(ROOT))


if __name__ == "__main__":
    main()
