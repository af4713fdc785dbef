"""Carried layers of a rolling shutter: each row from the sub-frame in which it is exposed."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from clpipe.base.errors import ImageError, RequestError
from clpipe.base.types import Array, Mask
from clpipe.chain.carry import AovSpec
from clpipe.chain.chain import Chain
from clpipe.chain.exposures import shutter_in
from clpipe.chain.registry import stage_in
from clpipe.chain.request import Request
from clpipe.images.read import SourceImage
from clpipe.inputs.carry import CarriedLayers, carry, geometry_of
from clpipe.inputs.companions import find_carried_layers
from clpipe.reference.carried import Layer, warp
from clpipe.stage import StageRole
from clpipe.stages.shutter import Rows


def carry_rows(
    paths: Sequence[Path],
    source: SourceImage,
    chain: Chain,
    layers: Sequence[AovSpec],
    max_pixels: int,
    orientation: int = 1,
) -> CarriedLayers:
    """Return the layers of an exposure, each row from the file in the middle of its exposure.

    Flow leads to the row of the other frame in which the surface is seen.

    Args:
        paths: the files of the exposure, the first one first.
        source: the image.
        chain: the chain whose stages move pixels.
        layers: the layers to carry.
        max_pixels: a file with more pixels is rejected before it is read.
        orientation: as for :func:`clpipe.inputs.carry.carry`.

    Raises:
        ImageError: as for :func:`clpipe.inputs.carry.carry`, or files have different layers.
        RequestError: the time between frames is not known, but a layer is flow.
    """
    width, height = source.pixels.shape[1::-1]
    shutter = shutter_in(chain)
    assert shutter  # it has combined the files
    _, rows = source.margins.frame_size(width, height)
    by_row = shutter.frames_at_middles(len(paths), rows)
    by_row = by_row[np.clip(np.arange(height) - source.margins.top, 0, rows - 1)]
    by_pixel = np.broadcast_to(by_row[:, None, None], (height, width, 1))
    (numbers,), _ = warp([Layer("label", by_pixel)], geometry_of(chain, orientation), width, height)
    row_step = 0.0
    if any(each.kind == "flow" for each in find_carried_layers(paths[0], layers)):
        row_step = _row_step(shutter)
    combined: CarriedLayers | None = None
    for number in np.unique(by_row):
        path = paths[int(number)]
        part = carry(path, source, chain, layers, max_pixels, orientation, row_step)
        combined = _combined(path, combined, part, numbers[..., 0] == number)
    assert combined
    return combined


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


def _row_step(shutter: Rows) -> float:
    """Return the time from the start of a row to the start of the next, in frames.

    Raises:
        RequestError: the time between frames is not known.
    """
    if not shutter.line_time:
        return 0.0
    if not shutter.frame_time:
        name = stage_in(StageRole.SHUTTER).name
        raise RequestError(
            f"--truth-at rows: optical flow needs {name}.frame_time, the time from frame to frame, "
            f"which is not set. For 24 frames per second, add --set {name}.frame_time={1 / 24:.6f}"
        )
    return shutter.line_time / shutter.frame_time


def _combined(
    path: Path, others: CarriedLayers | None, part: CarriedLayers, chosen: Mask
) -> CarriedLayers:
    """Return the layers of a file at chosen pixels, and elsewhere those of the other files.

    Raises:
        ImageError: the layers of the file differ from those of the others.
    """
    named = [replace(e, record={**e.record, "moment": "rows"}) for e in part.layers]
    if others is None:
        return replace(part, layers=tuple(named))
    if [(e.name, e.channels) for e in named] != [(e.name, e.channels) for e in others.layers]:
        raise ImageError(
            f"{path}: its layers differ from those of other files of the same exposure; render "
            "all files with the same layers"
        )

    def choose(new: Array, old: Array) -> Array:
        return np.where(chosen.reshape(chosen.shape + (1,) * (new.ndim - 2)), new, old)

    return replace(
        others,
        layers=tuple(
            replace(old, pixels=choose(new.pixels, old.pixels))
            for new, old in zip(named, others.layers, strict=True)
        ),
        valid=choose(part.valid, others.valid),
        other_records=(*others.other_records, *(each.record for each in named)),
    )
