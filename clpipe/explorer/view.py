"""Views of a result: displayed pixels, values, and parts to measure."""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from clpipe.analysis.pictures import Picture
from clpipe.base.errors import RequestError
from clpipe.base.types import Array, Floats
from clpipe.chain.chain import Chain
from clpipe.engine.runner import Result
from clpipe.images.preview import light_to_srgb
from clpipe.stage import Kind


@dataclass(frozen=True)
class View:
    """The image after a step ("" is the last one), or its truth.

    ``truth`` is one of :data:`~clpipe.chain.rendition.PICTURES`, or "" for the noisy image.
    """

    step: str = ""
    truth: str = ""


@dataclass(frozen=True)
class Sample:
    """A developed image, oriented like the pictures of ``clpipe run``.

    ``image`` has the values, in ``unit``. ``shown`` is (height, width, 3) uint8, for display.
    ``facts`` are JSON values about the image.
    """

    image: Array
    unit: str
    shown: Array
    facts: Mapping[str, Any]


UNITS = {
    Kind.RGB: "linear, 1 = full scale",
    Kind.MOSAIC: "signal, 1 = white level",
    Kind.RAW: "DN",
    Kind.DISPLAY: "of 1",
}


def display_pixels(chain: Chain, result: Result) -> Array:
    """Return a result for display, (height, width, 3) uint8."""
    image = result.image
    if result.encoded is None:
        image = light_to_srgb(to_signal(image, chain))
    return image if image.ndim == 3 else np.repeat(image[..., None], 3, axis=2)


def to_signal(image: Floats, chain: Chain) -> Floats:
    """Return a result scaled to 0 at black and 1 at white. Only raws need scaling."""
    context = chain.context_after
    black, white = context.black_level, context.white_level
    if chain.result is not Kind.RAW or black is None or white is None:
        return image
    return (image - np.float32(black)) / np.float32(white - black)


def cut(image: Array, box: tuple[int, int, int, int]) -> Array:
    """Return a part of an image by left, top, width and height. Mosaics keep whole 2x2 cells.

    >>> cut(np.arange(12).reshape(3, 4), (1, 0, 3, 3)).tolist()
    [[0, 1], [4, 5]]

    Raises:
        RequestError: the part is empty, or not inside the image.
    """
    left, top, width, height = box
    if image.ndim == 2:
        left, top, width, height = (size // 2 * 2 for size in box)
    inside = (
        0 <= left <= left + width <= image.shape[1] and 0 <= top <= top + height <= image.shape[0]
    )
    if not inside or width < 1 or height < 1:
        raise RequestError(
            f"the rectangle {box[2]}x{box[3]} at {box[0]}, {box[1]} is not in the image of "
            f"{image.shape[1]}x{image.shape[0]} px, or is empty"
        )
    return image[top : top + height, left : left + width]


def measurable_part(name: str, part: Array, chain: Chain) -> Picture:
    """Return a part of a result to measure, as if read from a file."""
    path, kind, context = Path(name), chain.result, chain.context_after
    if kind is Kind.DISPLAY:
        step = 1 / 255
        pixels = part.astype(np.float32) * np.float32(step)
        return Picture(path, "display", pixels, black=0.0, white=1.0, step=step)
    if kind is Kind.RGB:
        return Picture(path, "rgb", part, white=1.0)
    black, white = context.black_level, context.white_level
    lowest = None if black is None or white is None else -black / (white - black)
    return Picture(
        path, "mosaic", to_signal(part, chain), context.filter_array.pattern, lowest, 1.0
    )
