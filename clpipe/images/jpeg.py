"""How a JPEG was encoded, and pictures as the same encoding leaves them."""

from dataclasses import dataclass
from io import BytesIO
from pathlib import Path
from typing import Literal

import numpy as np
from PIL import Image, JpegImagePlugin, UnidentifiedImageError

from clpipe.base.errors import ImageError
from clpipe.base.types import Array

Subsampling = Literal["4:4:4", "4:2:2", "4:2:0"]
SUBSAMPLINGS: tuple[Subsampling, ...] = ("4:4:4", "4:2:2", "4:2:0")  # as Pillow counts them

# The table for luma of JPEG's annex K (ITU-T T.81, table K.1), in zigzag order from its first row;
# libjpeg scales it by the quality.
LUMA_TABLE = (
    *(16, 11, 10, 16, 24, 40, 51, 61, 12, 12, 14, 19, 26, 58, 60, 55),
    *(14, 13, 16, 24, 40, 57, 69, 56, 14, 17, 22, 29, 51, 87, 80, 62),
    *(18, 22, 37, 56, 68, 109, 103, 77, 24, 35, 55, 64, 81, 104, 113, 92),
    *(49, 64, 78, 87, 103, 121, 120, 101, 72, 92, 95, 98, 112, 100, 103, 99),
)


@dataclass(frozen=True)
class JpegEncoding:
    """The quality of a JPEG, 1 to 100 as libjpeg counts it, and its chroma subsampling."""

    quality: int
    subsampling: Subsampling


def scaled_table(quality: int) -> Array:
    """libjpeg's quantisation table for luma at a quality, (64,).

    >>> scaled_table(50)[:3].tolist(), scaled_table(100).max().item()
    ([16, 11, 10], 1)
    """
    scale = 5000 // quality if quality < 50 else 200 - 2 * quality
    return np.clip((np.array(LUMA_TABLE) * scale + 50) // 100, 1, 255)


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
    # Sorted, since the order of a table in memory is not the same in all versions of Pillow.
    distances = [np.abs(np.sort(scaled_table(q)) - own).sum() for q in range(1, 101)]
    return JpegEncoding(int(np.argmin(distances)) + 1, SUBSAMPLINGS[sampling])


def through_jpeg(pixels: Array, encoding: JpegEncoding) -> Array:
    """A picture, (height, width, 3) uint8, as a JPEG of this encoding leaves it."""
    file = BytesIO()
    Image.fromarray(pixels).save(
        file, "JPEG", quality=encoding.quality, subsampling=encoding.subsampling
    )
    with Image.open(file) as image:
        return np.asarray(image)
