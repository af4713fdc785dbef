"""Sheets of pictures for the documentation."""

from collections.abc import Iterable, Sequence

import numpy as np
from PIL import Image, ImageDraw, ImageFont

from clpipe.base.types import Array

GAP, HEAD, SIZE = 6, 26, 15  # px: between pictures, of captions, and of their letters


def enlarged(crop: Array, scale: int) -> Array:
    """Enlarge a picture; each pixel becomes a block."""
    return crop.repeat(scale, 0).repeat(scale, 1)


def sheet(rows: Iterable[Iterable[tuple[str, Array]]], names: Sequence[str] = ()) -> Image.Image:
    """Draw pictures of one size in rows.

    Args:
        rows: the caption above each picture, and its pixels, (height, width, 3) uint8. A row
            without captions has no space for them.
        names: captions to the left of the rows, one for each if there are any.
    """
    cells = [list(row) for row in rows]
    height, width = cells[0][0][1].shape[:2]
    heads = [HEAD * any(caption for caption, _ in row) for row in cells]
    font = ImageFont.load_default(SIZE)
    left = int(max((font.getlength(name) for name in names), default=-10) + 10)
    size = left + max(map(len, cells)) * (width + GAP), sum(heads) + len(cells) * (height + GAP)
    page = Image.new("RGB", size, "white")
    pen = ImageDraw.Draw(page)
    for number, row in enumerate(cells):
        top = sum(heads[: number + 1]) + number * (height + GAP)
        if names:
            pen.text((2, top + height // 2 - 10), names[number], "black", font)
        for column, (caption, pixels) in enumerate(row):
            x = left + column * (width + GAP)
            pen.text((x + 2, top - HEAD + 4), caption, "black", font)
            page.paste(Image.fromarray(np.ascontiguousarray(pixels)), (x, top))
    return page
