"""Make pictures of a render before and after the camera.

    tools/run pages readme_picture

docs/before_after.png is the README's picture: crops of a render and of clpipe's pictures. The other
ones are those of docs/before_and_after.md: a crop for each task.
"""

import numpy as np

import clpipe
from clpipe.base.types import Array
from clpipe.images.read import read_image
from clpipe.reference.curve import to_8_bit
from clpipe.reference.transfer import srgb_curve
from tools import RENDER, ROOT
from tools.shared.options import parser_of
from tools.shared.pictures import enlarged, sheet

CROPS = ((112, 226, 110, 80), (560, 300, 110, 80), (420, 470, 110, 80))  # x, y, width, height
SCALE = 3
ISOS = (800, 6400)


def plain(pixels: Array) -> Array:
    """Convert linear RGB like a viewer: clipped, in sRGB, eight bits."""
    return to_8_bit(np.float32(srgb_curve(np.clip(pixels.astype(np.float64), 0, 1))))


Rows = list[list[tuple[str, Array]]]

MOVED = 24  # px that the camera moves while the shutter is open
SUBFRAMES = 24


def readme(render: Array) -> Rows:
    """Return crops of the render and of pictures at two ISOs."""
    pictures = [("render, sRGB", plain(render))]
    for iso in ISOS:
        shot = clpipe.Pipeline(iso=iso).process(render, RENDER.name)
        pictures.append((f"clpipe, ISO {iso}", shot.image))
    return [
        [(caption * (number == 0), cut(pixels, *crop)) for caption, pixels in pictures]
        for number, crop in enumerate(CROPS)
    ]


def cut(pixels: Array, x: int, y: int, width: int, height: int, scale: int = SCALE) -> Array:
    """Return a crop, enlarged."""
    return enlarged(pixels[y : y + height, x : x + width], scale)


def denoising(render: Array) -> Rows:
    """Return a render, its noisy picture and the noise-free truth of this picture."""
    camera = clpipe.Pipeline(iso=6400)
    noisy, clean = camera.process(render, "a"), camera.process(render, "a", skip=["noise"])
    crop = 420, 470, 110, 80
    shown = {"render, sRGB": plain(render), "picture": noisy.image, "clean truth": clean.image}
    return [[(name, cut(pixels, *crop)) for name, pixels in shown.items()]]


def raws(render: Array) -> Rows:
    """Return a render, and its noisy raw of a colour and of a grey sensor."""
    shown = {"render, sRGB": plain(render)}
    for camera, name in (("sony-imx264", "raw, Bayer"), ("sony-imx900", "raw, mono")):
        shot = clpipe.Pipeline(camera=camera, until="normalize").process(render, "a")
        shown[name] = plain(np.repeat(shot.image.reshape(*shot.image.shape[:2], 1), 3, 2))
    return [[(name, cut(pixels, 300, 240, 55, 40, 2 * SCALE)) for name, pixels in shown.items()]]


def motion(render: Array) -> Rows:
    """Return a still render, and one whose camera moves, with a global and a rolling shutter."""
    shown = {"render, sRGB": plain(render)}
    frames = [np.roll(render, -MOVED * n // (SUBFRAMES - 1), 1) for n in range(SUBFRAMES)]
    times = {"global shutter, 1/50 s": (0.02, 0.0), "rolling, 1/500 s": (0.002, 0.018 / 640)}
    for name, (time, row) in times.items():
        shutter = {"subframes": SUBFRAMES, "exposure_time": time, "line_time": row}
        with clpipe.Stream(shutter=shutter, iso=400) as camera:
            shown[name] = camera(frames).image
    return [[(name, cut(pixels, 600, 200, 165, 240, 2)) for name, pixels in shown.items()]]


def lamps(render: Array) -> Rows:
    """Return a render, and pictures under lamps that flicker, in a row and at night."""
    shown = {"render, sRGB": plain(render)}
    flicker = {"flicker_depth": 0.6, "line_time": 4e-5, "exposure_time": 0.002}
    shown["lamps at 100 Hz"] = clpipe.Pipeline(iso=400, shutter=flicker).process(render, "a").image
    night = clpipe.Pipeline(iso=25600, exposure={"method": "auto"}, control={})
    shown["at night"] = night.process(render / 500, "a").image
    return [[(name, cut(pixels, 0, 0, 960, 640, 1)[::3, ::3]) for name, pixels in shown.items()]]


TASKS = {"denoising": denoising, "raw": raws, "motion": motion, "lamps": lamps}


def main() -> None:
    """Write the pictures."""
    parser_of(__doc__).parse_args()
    render = read_image(RENDER).pixels
    sheet(readme(render)).save(ROOT / "docs" / "before_after.png", optimize=True)
    for name, rows in TASKS.items():
        path = ROOT / "docs" / f"task_{name}.webp"
        sheet(rows(render)).save(path, quality=88, method=6)


if __name__ == "__main__":
    main()
