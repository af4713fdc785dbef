"""Make docs/before_after.png, the README's picture: crops of a render and of clpipe's pictures.

Usage: tools/run pages readme_picture
"""

import numpy as np
from PIL import Image, ImageDraw, ImageFont

import clpipe
from clpipe.base.types import Array
from clpipe.images.read import read_image
from clpipe.reference.curve import to_8_bit
from clpipe.reference.transfer import srgb_curve
from tools import RENDER, ROOT

CROPS = ((112, 226, 110, 80), (560, 300, 110, 80), (420, 470, 110, 80))  # x, y, width, height
SCALE = 3
ISOS = (800, 6400)


def plain(pixels: Array) -> Array:
    """Convert linear RGB like a viewer: clipped, in sRGB, eight bits."""
    return to_8_bit(np.float32(srgb_curve(np.clip(pixels.astype(np.float64), 0, 1))))


def sheet(columns: list[tuple[str, Image.Image]]) -> Image.Image:
    """Draw enlarged crops, with a captioned column for each picture."""
    gap, head = 6, 30
    width, height = (side * SCALE for side in CROPS[0][2:])
    size = (len(columns) * (width + gap) - gap, head + len(CROPS) * (height + gap) - gap)
    page = Image.new("RGB", size, "white")
    draw = ImageDraw.Draw(page)
    font = ImageFont.load_default(17)
    for i, (caption, image) in enumerate(columns):
        x = i * (width + gap)
        draw.text((x + 2, 4), caption, fill="black", font=font)
        for j, (left, top, w, h) in enumerate(CROPS):
            crop = image.crop((left, top, left + w, top + h))
            enlarged = crop.resize((width, height), Image.Resampling.NEAREST)
            page.paste(enlarged, (x, head + j * (height + gap)))
    return page


def main() -> None:
    """Write the picture."""
    render = read_image(RENDER).pixels
    pictures = [("render, sRGB", plain(render))]
    for iso in ISOS:
        shot = clpipe.Pipeline(iso=iso).process(render, RENDER.name)
        pictures.append((f"clpipe, ISO {iso}", shot.image))
    columns = [(caption, Image.fromarray(pixels)) for caption, pixels in pictures]
    sheet(columns).save(ROOT / "docs" / "before_after.png", optimize=True)


if __name__ == "__main__":
    main()
