"""Carried layers of a rolling shutter: each row from the file in which it is exposed."""

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from clpipe.base.errors import RequestError
from clpipe.base.types import Array
from clpipe.chain.chain import Chain
from clpipe.chain.exposures import shutter_in
from clpipe.chain.registry import stage_in
from clpipe.chain.request import Request
from clpipe.images.pixels import display_window
from clpipe.reference.carried import Layer
from clpipe.reference.geometry import Margins
from clpipe.stage import StageRole


def files_by_row(chain: Chain, count: int, height: int, margins: Margins) -> Array:
    """Return the number of the file in the middle of each row's exposure: (height,).

    Args:
        chain: the chain, whose shutter has combined the files.
        count: the number of files of the exposure.
        height: the height of the image with its overscan, in px.
        margins: the overscan.
    """
    if count == 1:
        return np.zeros(height, np.intp)
    shutter = shutter_in(chain)
    assert shutter
    _, rows = margins.frame_size(0, height)
    in_picture = np.clip(np.arange(height) - margins.top, 0, rows - 1)
    return shutter.frames_at_middles(count, rows)[in_picture]


def combine_rows(parts: Mapping[int, Layer], by_row: Array) -> Layer:
    """Return a layer, each row from its file. It is 0 outside of the data window of a file.

    Args:
        parts: the layer in each file, by the number of the file.
        by_row: the number of the file of each row of the image.
    """
    first, *others = parts.values()
    if not others:
        return first
    left, top = min(each.x for each in parts.values()), min(each.y for each in parts.values())
    right = max(each.x + each.pixels.shape[1] for each in parts.values())
    bottom = max(each.y + each.pixels.shape[0] for each in parts.values())
    numbers = by_row[np.clip(np.arange(top, bottom), 0, len(by_row) - 1)]
    pixels = np.zeros((bottom - top, right - left, first.pixels.shape[2]), first.pixels.dtype)
    for number, each in parts.items():
        window = display_window(each.pixels, each.x - left, each.y - top, *pixels.shape[1::-1])
        pixels[numbers == number] = window[numbers == number]
    return replace(first, pixels=pixels, x=left, y=top)


def row_step(chain: Chain) -> float:
    """Return the time from the start of a row to the start of the next, in frames.

    Raises:
        RequestError: the time between frames is not known.
    """
    shutter = shutter_in(chain)
    if not (shutter and shutter.line_time):
        return 0.0
    if not shutter.frame_time:
        name = stage_in(StageRole.SHUTTER).name
        raise RequestError(
            f"--truth-at rows: optical flow needs {name}.frame_time, the time from frame to frame, "
            f"which is not set. For 24 frames per second, add --set {name}.frame_time={1 / 24:.6f}"
        )
    return shutter.line_time / shutter.frame_time


def rows_note(request: Request, chain: Chain) -> str:
    """Return a note if layers show another moment than the rows of a rolling shutter, else ""."""
    shutter = shutter_in(chain)
    is_rolling = shutter is not None and shutter.subframes > 1 and shutter.line_time > 0
    if not request.carry or request.truth_at == "rows" or not is_rolling:
        return ""
    return (
        f"--carry: layers show one moment ({request.truth_at}), but the rows of this rolling "
        "shutter show different ones. To take each row from its own moment, add --truth-at rows"
    )
