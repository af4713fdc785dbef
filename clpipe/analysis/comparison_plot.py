"""Draws a comparison: rows of crops, columns of pictures, and text.

Everything is placed in whole pixels at 300 dpi, so each pixel of a crop becomes a square.
"""

import logging
import os
import textwrap
import warnings
from collections.abc import Sequence
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib import rc_context
from matplotlib.figure import Figure

from clpipe.analysis.comparison import Comparison, Noise
from clpipe.base.errors import RequestError
from clpipe.base.files import check_suffix, write_new
from clpipe.base.text import one_line
from clpipe.base.types import Array
from clpipe.reference.curve import to_8_bit

log = logging.getLogger(__name__)

DPI = 300
MAX_PIXELS = 1 << 26  # pixels of the largest figure; drawing it takes 256 MB
GAP = 12  # px; the gap between crops, and the outer margin
SIZE, SMALL = 7, 6  # points; font sizes
# px; the height of a line and the width of a digit, for DejaVu Sans at one point.
LINE, LETTER = (each * DPI / 72 for each in (1.25, 0.64))

SUFFIXES = (".png", ".pdf", ".svg")
# Text remains text, and each crop is an image. Files do not depend on the time.
STYLE = {
    "image.composite_image": False,
    "pdf.fonttype": 42,
    "svg.fonttype": "none",
    "svg.hashsalt": "clpipe",
}
METADATA = {".png": {}, ".pdf": {"CreationDate": None}, ".svg": {"Date": None}}


def check_name(path: Path, pictures: Sequence[Path]) -> None:
    """Check that a figure can have this name and that no picture has it.

    Raises:
        RequestError: its extension is unknown, or a picture has that name.
    """
    check_suffix("-o", path, *SUFFIXES)
    if os.path.realpath(path) in map(os.path.realpath, pictures):
        raise RequestError(f"-o: {path} is one of the pictures; give the figure another name")


def draw(comparison: Comparison, path: Path, zoom: int = 4) -> None:
    """Draw a comparison as PNG, PDF or SVG, according to the extension.

    Args:
        comparison: the content.
        path: the file.
        zoom: the side of the square for each pixel of a crop, in pixels at 300 dpi.

    Raises:
        RequestError: the figure would be too large.
        ImageError: the file cannot be written.
    """
    words = [len(word) for label in comparison.labels for word in label.split()]
    crops = max(place.width for place in comparison.places) * zoom
    columns = max(crops, round(max(words, default=0) * LETTER * SIZE))
    heads = [_wrapped(label, columns, SIZE) for label in comparison.labels]
    feet = [_foot(noise) for noise in comparison.noise]
    sides = [_wrapped(row.name, row.crops[0].shape[0] * zoom, SIZE) for row in comparison.rows]
    left = GAP + _height(sides, SIZE)
    width = left + len(heads) * (columns + GAP)
    notes = [_wrapped(note, width - 2 * GAP, SMALL) for note in comparison.notes]
    tops, bottom = [], GAP + _height(heads, SIZE)
    for row in comparison.rows:
        tops.append(bottom)
        bottom += row.crops[0].shape[0] * zoom + GAP
    below = bottom + _height(feet, SIZE)
    height = below + sum(_height([note], SMALL) for note in notes) + GAP
    if width * height > MAX_PIXELS:
        raise RequestError(
            f"{path}: the figure would have {width}x{height} pixels, more than "
            f"{MAX_PIXELS:,}; give smaller crops, fewer of them, or a smaller --zoom"
        )
    figure = Figure(figsize=(width / DPI, height / DPI), dpi=DPI)
    page = figure.add_axes((0, 0, 1, 1))
    page.set_axis_off()

    def write(x: float, y: float, text: str, size: int = SIZE, **how: Any) -> None:
        page.text(x, y, text, size=size, parse_math=False, **how)

    for column, head in enumerate(heads):
        middle = left + column * (columns + GAP) + columns / 2
        write(middle, tops[0] - GAP / 2, head, ha="center", va="bottom")
        if feet:
            write(middle, bottom, feet[column], ha="center", va="top")
    for row, top, side in zip(comparison.rows, tops, sides, strict=True):
        middle = top + row.crops[0].shape[0] * zoom / 2
        at = left - GAP / 2, middle
        write(*at, side, ha="right", va="center", rotation=90, multialignment="center")
        for column, crop in enumerate(row.crops):
            tall, wide = (pixels * zoom for pixels in crop.shape[:2])
            x = left + column * (columns + GAP)
            place = (x, x + wide, top + tall, top)
            page.imshow(_enlarged(crop, zoom), interpolation="none", aspect="auto", extent=place)
    page.set(xlim=(0, width), ylim=(height, 0))  # imshow changes the limits
    for note in notes:
        write(GAP, below, note, SMALL, va="top")
        below += _height([note], SMALL)
    data = BytesIO()
    with rc_context(STYLE), warnings.catch_warnings(record=True) as missing:
        warnings.simplefilter("always")
        figure.savefig(data, format=path.suffix[1:], metadata=METADATA[path.suffix])
    if missing:
        log.warning("%s: the font lacks letters of the labels; choose others with --label", path)
    write_new(path, data.getvalue())


def _wrapped(text: str, width: int, size: int) -> str:
    """Return a text wrapped to a width in pixels."""
    return "\n".join(textwrap.wrap(one_line(text), max(int(width / (LETTER * size)), 1)))


def _height(texts: Sequence[str], size: int) -> int:
    """Return the height in pixels of the text with the most lines; 0 without texts."""
    return round(max((text.count("\n") + 1 for text in texts), default=0) * LINE * size)


def _foot(noise: Noise) -> str:
    """Return the noise of a picture in two lines."""
    if np.isnan(noise.sigma):
        return ""
    if not noise.sigma:
        return "no noise"
    rms = "" if np.isnan(noise.rms) else f"rms {noise.rms:.2f}, "
    return f"{rms}sigma {noise.sigma:.2f}\n2x2 leaves {noise.left:.2f}"


def _enlarged(crop: Array, zoom: int) -> Array:
    """Return an 8-bit crop in which each pixel of 0..1 is a square."""
    return to_8_bit(crop).repeat(zoom, 0).repeat(zoom, 1)
