"""Make pictures of the documentation: cameras and ISOs, ground truth, lamps.

    tools/run pages gallery

It writes docs/gallery_cameras.webp, docs/gallery_truths.webp and docs/gallery_lamps.webp. Their
cells are results of the commands above them in docs/index.md and docs/spectral.md. The ground truth
is of a view of the reconstruction.
"""

from pathlib import Path
from tempfile import TemporaryDirectory

import matplotlib
import numpy as np
import OpenImageIO as oiio
from PIL import Image

import clpipe
from clpipe.base.types import Array
from clpipe.camera.spectra import ILLUMINANTS
from tools import RENDER, ROOT
from tools.shared.options import parser_of
from tools.shared.pictures import enlarged, sheet

CAMERAS = ("sony-a7s2", "canon-6d", "nikon-d800", "oppo-reno-10x")
ISOS = (100, 1600, 6400)
CROP = (560, 292, 120, 96)  # x, y, width, height, with smooth places, edges and a dark corner
SCENE = ROOT / "tools" / "reconstruction" / "data" / "view0.exr"
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


def lamps(folder: Path) -> Image.Image:
    """Return a crop of a render under lamps, with gains for daylight and with their own."""
    left, top, width, height = CROP
    rows = []
    for gains in ("gains", "as_shot"):
        row = []
        for lamp in ILLUMINANTS:
            out = folder / gains / lamp
            settings = {"render": {"illuminant": lamp}, "white_balance": {"method": gains}}
            list(clpipe.run(RENDER, out, iso=1600, format="png", **settings))
            picture = Image.open(out / f"{RENDER.stem}.png")
            crop = np.asarray(picture.crop((left, top, left + width, top + height)))
            row.append((lamp if gains == "gains" else "", enlarged(crop, SCALE)))
        rows.append(row)
    return sheet(rows, ["gains", "as_shot"])


def truths(folder: Path) -> Image.Image:
    """Return a view of a scene with its ground truth."""
    options = {"truth": ["clean", "variance"], "carry": ["Z:depth", "texture:label"]}
    list(clpipe.run(SCENE, folder, format="png", iso=3200, distortion=LENS, **options))
    name = SCENE.stem
    pictures = {
        f"{name}.png": Image.open(folder / f"{name}.png"),
        "truth_clean.png": Image.open(folder / f"{name}.truth_clean.png"),
        "truth_variance.exr": coloured(np.sqrt(layer(folder / f"{name}.truth_variance.exr"))),
    }
    carried = folder / f"{name}.carried.exr"
    pictures["carried.exr: depth"] = coloured(-layer(carried, "Z"))
    pictures["carried.exr: textures"] = coloured(layer(carried, "texture"), "tab20")
    size = (240, 160)
    boxed = Image.Resampling.BOX
    small = {name: i.convert("RGB").resize(size, boxed) for name, i in pictures.items()}
    return sheet([[(name, np.asarray(picture)) for name, picture in small.items()]])


def layer(path: Path, word: str = "") -> Array:
    """Return the first channel of a file whose name contains a word, (height, width)."""
    image = oiio.ImageBuf(str(path))
    channel = next(i for i, name in enumerate(image.spec().channelnames) if word in name)
    return image.get_pixels(oiio.FLOAT)[..., channel]


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
        for stem, make in (("cameras", cameras), ("truths", truths), ("lamps", lamps)):
            path = ROOT / "docs" / f"gallery_{stem}.webp"
            make(Path(name, stem)).save(path, quality=88, method=6)
            print(path.relative_to(ROOT))


if __name__ == "__main__":
    main()
