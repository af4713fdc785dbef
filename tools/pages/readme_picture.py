"""Make docs/before_after.png, the README's picture: crops of a render and of clpipe's pictures.

Usage: tools/run pages readme_picture
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


def main() -> None:
    """Write the picture."""
    parser_of(__doc__).parse_args()
    render = read_image(RENDER).pixels
    pictures = [("render, sRGB", plain(render))]
    for iso in ISOS:
        shot = clpipe.Pipeline(iso=iso).process(render, RENDER.name)
        pictures.append((f"clpipe, ISO {iso}", shot.image))
    rows = [
        [
            (caption * (number == 0), enlarged(pixels[y : y + height, x : x + width], SCALE))
            for caption, pixels in pictures
        ]
        for number, (x, y, width, height) in enumerate(CROPS)
    ]
    sheet(rows).save(ROOT / "docs" / "before_after.png", optimize=True)


if __name__ == "__main__":
    main()
