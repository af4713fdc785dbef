"""Finds how a JPEG was encoded, and encodes other pictures in the same way."""

from dataclasses import dataclass
from functools import cache
from io import BytesIO
from pathlib import Path
from typing import Literal

import numpy as np
from PIL import Image, JpegImagePlugin, UnidentifiedImageError

from clpipe.base.errors import ImageError
from clpipe.base.types import Array

Subsampling = Literal["4:4:4", "4:2:2", "4:2:0"]
SUBSAMPLINGS: tuple[Subsampling, ...] = ("4:4:4", "4:2:2", "4:2:0")  # Pillow's numbers 0 to 2


@dataclass(frozen=True)
class JpegEncoding:
    """The quality of a JPEG on libjpeg's scale, 1 to 100, and its chroma subsampling."""

    quality: int
    subsampling: Subsampling


@cache
def luma_table(quality: int) -> Array:
    """Return libjpeg's quantisation table for luma at a quality, sorted, (64,).

    It is sorted, because the order depends on Pillow's version.

    >>> luma_table(50)[:3].tolist(), luma_table(100).max().item()
    ([10, 11, 12], 1)
    """
    file = BytesIO()
    Image.new("RGB", (8, 8)).save(file, "JPEG", quality=quality)
    with Image.open(file) as image:
        assert isinstance(image, JpegImagePlugin.JpegImageFile)
        return np.sort(np.array(image.quantization[0]))


def jpeg_encoding(path: Path) -> JpegEncoding | None:
    """Return a JPEG's encoding: the quality whose table is nearest to its own, and its subsampling.

    Return None if the file is not a JPEG, or clpipe does not write its subsampling.

    Raises:
        ImageError: the file cannot be read.
    """
    try:
        with Image.open(path) as image:
            if not isinstance(image, JpegImagePlugin.JpegImageFile) or image.mode != "RGB":
                return None
            sampling = JpegImagePlugin.get_sampling(image)
            table = np.sort(np.array(image.quantization[0]))
    except (OSError, UnidentifiedImageError) as error:
        raise ImageError(f"{path}: cannot be read: {error}") from None
    if sampling < 0:
        return None
    distances = [np.abs(luma_table(q) - table).sum() for q in range(1, 101)]
    return JpegEncoding(int(np.argmin(distances)) + 1, SUBSAMPLINGS[sampling])


def jpeg_round_trip(pixels: Array, encoding: JpegEncoding) -> Array:
    """Return a picture, (height, width, 3) uint8, after encoding it as JPEG and decoding it."""
    file = BytesIO()
    Image.fromarray(pixels).save(
        file, "JPEG", quality=encoding.quality, subsampling=encoding.subsampling
    )
    with Image.open(file) as image:
        return np.asarray(image)
