"""Markdown tables and sheets of crops that compare developments."""

from collections.abc import Iterable, Mapping, Sequence

import numpy as np
from PIL import Image, ImageDraw, ImageFont

from clpipe.analysis.crops import HEIGHT, WIDTH, Crop, choose_crops
from clpipe.base.types import Array

SCALE = 4  # enlargement of crops
GAP, HEAD, SIDE = 6, 24, 150  # px: between crops, above and left of them

# The columns of a signature in tables: heading, attribute, format.
COLUMNS = (
    ("rms", "rms", ".1f"),
    ("kurtosis", "kurtosis", ".1f"),
    ("beyond 4 sigma, 1e-4", "beyond_4_sigma", ".0f"),
    ("right", "right", ".2f"),
    ("below", "below", ".2f"),
    ("diagonal", "diagonal", ".2f"),
    ("2 right", "two_right", ".2f"),
    ("half", "half", ".2f"),
    ("chroma right", "chroma_right", ".2f"),
    ("R-G", "red_green", ".2f"),
)


def cells(record: Mapping[str, float]) -> list[str]:
    """Format the columns of a signature."""
    return [format(record[name], form) if name in record else "" for _, name, form in COLUMNS]


def markdown(heads: Sequence[str], rows: Iterable[Iterable[str]]) -> str:
    """Format a table.

    >>> print(markdown(["a", "b"], [["1", "2"]]))
    | a | b |
    |---|---|
    | 1 | 2 |
    """
    first, *others = (f"| {' | '.join(row)} |" for row in (heads, *rows))
    return "\n".join([first, "|---" * len(heads) + "|", *others])


def significant_places(picture: Array) -> list[Crop]:
    """Choose two places for crops: the most saturated one, and the one with the most detail.

    Args:
        picture: without noise, (height, width, 3), 0 to 255.
    """
    return choose_crops(("saturated", "textured"), picture.astype(np.float32) / np.float32(255))


def sheet(columns: Sequence[str], rows: Mapping[str, Sequence[Array]]) -> Image.Image:
    """Draw crops at 400 %, with a row for each caption and a column for each development.

    Args:
        columns: captions of the columns.
        rows: from a caption to one crop per column, (height, width, 3) uint8, all of one size.
    """
    height, width = (side * SCALE for side in (HEIGHT, WIDTH))
    size = SIDE + len(columns) * (width + GAP), HEAD + len(rows) * (height + GAP)
    page = Image.new("RGB", size, "white")
    draw, font = ImageDraw.Draw(page), ImageFont.load_default(15)
    for column, caption in enumerate(columns):
        draw.text((SIDE + column * (width + GAP), 3), caption, fill="black", font=font)
    for row, (caption, crops) in enumerate(rows.items()):
        top = HEAD + row * (height + GAP)
        draw.multiline_text((3, top), caption.replace(", ", "\n"), fill="black", font=font)
        for column, crop in enumerate(crops):
            enlarged = crop.repeat(SCALE, 0).repeat(SCALE, 1)
            page.paste(Image.fromarray(enlarged), (SIDE + column * (width + GAP), top))
    return page
