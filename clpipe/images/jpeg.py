"""How a JPEG was encoded, and pictures as the same encoding leaves them."""

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
SUBSAMPLINGS: tuple[Subsampling, ...] = ("4:4:4", "4:2:2", "4:2:0")  # as Pillow counts them


@dataclass(frozen=True)
class JpegEncoding:
    """The quality of a JPEG, 1 to 100 as libjpeg counts it, and its chroma subsampling."""

    quality: int
    subsampling: Subsampling


@cache
def luma_table(quality: int) -> Array:
    """libjpeg's quantisation table for luma at a quality, sorted, (64,).

    Sorted, since the order of a table in memory is not the same in all versions of Pillow.

    >>> luma_table(50)[:3].tolist(), luma_table(100).max().item()
    ([10, 11, 12], 1)
    """
    file = BytesIO()
    Image.new("RGB", (8, 8)).save(file, "JPEG", quality=quality)
    with Image.open(file) as image:
        assert isinstance(image, JpegImagePlugin.JpegImageFile)
        return np.sort(np.array(image.quantization[0]))


def jpeg_encoding(path: Path) -> JpegEncoding | None:
    """How a JPEG was encoded: the quality whose table is nearest to its own, and its subsampling.

    None where the file is no JPEG, or its subsampling is none that clpipe writes.

    Raises:
        ImageError: the file cannot be read.
    """
    try:
        with Image.open(path) as image:
            if not isinstance(image, JpegImagePlugin.JpegImageFile) or image.mode != "RGB":
                return None
            sampling = JpegImagePlugin.get_sampling(image)
            own = np.sort(np.array(image.quantization[0]))
    except (OSError, UnidentifiedImageError) as error:
        raise ImageError(f"{path}: cannot be read: {error}") from None
    if sampling < 0:
        return None
    distances = [np.abs(luma_table(q) - own).sum() for q in range(1, 101)]
    return JpegEncoding(int(np.argmin(distances)) + 1, SUBSAMPLINGS[sampling])


def through_jpeg(pixels: Array, encoding: JpegEncoding) -> Array:
    """A picture, (height, width, 3) uint8, as a JPEG of this encoding leaves it."""
    file = BytesIO()
    Image.fromarray(pixels).save(
        file, "JPEG", quality=encoding.quality, subsampling=encoding.subsampling
    )
    with Image.open(file) as image:
        return np.asarray(image)
