"""Contact sheets: small pictures in rows and columns, with their names."""

import io
from collections.abc import Sequence
from pathlib import Path

from PIL import Image, ImageDraw, ImageFont

from clpipe.images.preview import thumbnail

SHEET_SUFFIXES = (".jpg", ".png", ".tif")  # extensions of pictures that can be on a sheet

THUMBNAIL = 240  # px; the longer side of a thumbnail
TEXT = 14  # px; the height of text
GAP = 6  # px
BACKGROUND, INK = (250, 250, 250), (30, 30, 30)


def contact_sheet(
    rows: Sequence[Sequence[Path]], names: Sequence[str], titles: Sequence[str]
) -> bytes:
    """Return a JPEG with a grid of pictures.

    Args:
        rows: 8-bit pictures; each row has one for each column.
        names: the names of the rows.
        titles: the titles of the columns.

    Raises:
        ImageError: a picture cannot be read.
    """
    small = [[thumbnail(path, str(path), THUMBNAIL) for path in row] for row in rows]
    width = max(each.width for row in small for each in row)
    height = max(each.height for row in small for each in row)
    across, down = width + GAP, height + TEXT + 2 * GAP
    size = GAP + across * len(titles), TEXT + 2 * GAP + down * len(rows)
    sheet = Image.new("RGB", size, BACKGROUND)
    draw = ImageDraw.Draw(sheet)
    font = ImageFont.load_default(TEXT)
    for column, title in enumerate(titles):
        draw.text((GAP + column * across, GAP), title, INK, font)
    for number, (row, name) in enumerate(zip(small, names, strict=True)):
        top = TEXT + 2 * GAP + number * down
        for column, each in enumerate(row):
            sheet.paste(each, (GAP + column * across, top))
        draw.text((GAP, top + height + GAP / 2), name, INK, font)
    data = io.BytesIO()
    sheet.save(data, "JPEG", quality=90)
    return data.getvalue()
