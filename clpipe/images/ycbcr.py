"""Conversion between RGB and the YCbCr of video files: matrices, ranges and subsampling.

libswscale's conversions are not used. By default, they have the matrix of BT.601, and their luma
of 10 bits is 1.7 levels too bright.
"""

from collections.abc import Sequence

import numpy as np

from clpipe.base.types import Array, Floats

BT709 = 1  # codes of matrices, ITU-T H.273 (2024), table 4

# The weights of red and blue in luma, by the code of the matrix.
WEIGHTS = {BT709: (0.2126, 0.0722), 5: (0.299, 0.114), 6: (0.299, 0.114), 9: (0.2627, 0.0593)}


def to_ycbcr(matrix: int = BT709) -> Floats:
    """Return the matrix that converts RGB, 0 to 1, to Y, 0 to 1, and Cb and Cr, -0.5 to 0.5.

    Args:
        matrix: the code of the matrix, one of :data:`WEIGHTS`.

    >>> to_ycbcr()[0].astype(float).round(4).tolist()
    [0.2126, 0.7152, 0.0722]
    """
    red, blue = WEIGHTS[matrix]
    luma = np.array([red, 1 - red - blue, blue])
    differences = (np.eye(3)[[2, 0]] - luma) / (2 - 2 * np.array([[blue], [red]]))
    return np.vstack([luma, differences]).astype(np.float32)


def encode_420(rgb: Array, bits: int) -> list[Array]:
    """Convert a picture to planes Y, Cb and Cr of BT.709 in limited range, 4:2:0.

    Chroma is sampled at the left column of each 2x2 block, and between its rows. This is the
    default of H.264 and H.265.

    Args:
        rgb: (height, width, 3) uint8 or uint16, full range. Height and width are even.
        bits: bits per sample of the planes.

    Returns:
        Planes of uint8 or uint16. Cb and Cr have half the height and width.
    """
    table = to_ycbcr() / np.float32(np.iinfo(rgb.dtype).max)
    luma, *chroma = (sum(rgb[..., c] * weight for c, weight in enumerate(row)) for row in table)
    planes = [16 + 219 * luma]
    for plane in chroma:
        rows = plane[::2] + plane[1::2]
        left = np.pad(rows, ((0, 0), (1, 0)), mode="edge")
        planes.append(128 + 28 * (left[:, :-2:2] + 2 * left[:, 1::2] + left[:, 2::2]))
    dtype = np.uint8 if bits == 8 else np.uint16
    scale = np.float32(2 ** (bits - 8))
    return [np.rint(plane * scale).astype(dtype) for plane in planes]


def decode(planes: Sequence[Array], bits: int, matrix: int = BT709, is_full: bool = False) -> Array:
    """Convert planes Y, Cb and Cr to a picture.

    Args:
        planes: the planes, uint8 or uint16. Cb and Cr have the size of Y, or half its height and
            width like from :func:`encode_420`.
        bits: bits per sample of the planes.
        matrix: the code of the matrix, one of :data:`WEIGHTS`.
        is_full: whether the samples have full range.

    Returns:
        (height, width, 3) uint8 for 8 bits, else uint16; full range.
    """
    scale = 2 ** (bits - 8)
    full, limited = (0, 2**bits - 1, 2**bits - 1), (16 * scale, 219 * scale, 224 * scale)
    black, span, chroma_span = map(np.float32, full if is_full else limited)
    luma = (planes[0] - black) / span
    chroma = [(plane - np.float32(128 * scale)) / chroma_span for plane in planes[1:]]
    if chroma[0].shape != luma.shape:
        chroma = [_doubled(plane)[: luma.shape[0], : luma.shape[1]] for plane in chroma]
    table = np.linalg.inv(to_ycbcr(matrix).astype(np.float64)).astype(np.float32)
    dtype = np.uint8 if bits == 8 else np.uint16
    largest = np.float32(np.iinfo(dtype).max)
    rgb = np.empty((*luma.shape, 3), dtype)
    for c, (_, cb, cr) in enumerate(table):
        value = (luma + cb * chroma[0] + cr * chroma[1]) * largest
        rgb[..., c] = np.rint(np.clip(value, 0, largest))
    return rgb


def _doubled(plane: Floats) -> Floats:
    """Return a chroma plane of 4:2:0 at the positions of luma, by linear interpolation."""
    padded = np.pad(plane, ((1, 1), (0, 1)), mode="edge")
    middle, above, below = 0.75 * padded[1:-1], 0.25 * padded[:-2], 0.25 * padded[2:]
    rows = np.stack([middle + above, middle + below], 1).reshape(-1, padded.shape[1])
    left, right = rows[:, :-1], rows[:, 1:]
    return np.stack([left, (left + right) / 2], 2).reshape(len(rows), -1)
