"""The format of the arrays of a sample: type, order of axes, and packing of raws. Pure."""

from dataclasses import dataclass
from typing import Any, Literal

import numpy as np

from clpipe.base.errors import ImageError, RequestError
from clpipe.base.text import unknown_name
from clpipe.base.types import Array
from clpipe.reference.cfa import sites
from clpipe.stage import Kind

DTYPES = ("float16", "float32", "uint16")
HIGHEST = 65535  # the maximum of uint16

RawForm = Literal["packed", "mosaic"]


def dtype_named(dtype: Any) -> str | None:
    """Return the name of a type of :data:`DTYPES`. None stays None.

    Raises:
        RequestError: it is another type, or not a type.
    """
    if dtype is None:
        return None
    try:
        name = np.dtype(dtype).name
    except TypeError:
        name = str(dtype)
    if name not in DTYPES:
        raise RequestError(unknown_name("dtype", name, DTYPES))
    return name


def packed(mosaic: Array, pattern: str) -> Array:
    """Pack a mosaic of even size into planes R, Gr, Gb, B: (4, height / 2, width / 2).

    Gr is green in the rows of red.

    >>> packed(np.array([[1, 2], [3, 4]]), "GRBG").ravel().tolist()
    [2, 1, 4, 3]
    """
    return np.stack([mosaic[site] for site in sites(pattern).values()])


def unpacked(planes: Array, pattern: str) -> Array:
    """Return the mosaic of planes from :func:`packed`.

    >>> unpacked(np.array([2, 1, 4, 3]).reshape(4, 1, 1), "GRBG").tolist()
    [[1, 2], [3, 4]]
    """
    _, height, width = planes.shape
    mosaic = np.empty((2 * height, 2 * width), planes.dtype)
    for plane, site in zip(planes, sites(pattern).values(), strict=True):
        mosaic[site] = plane
    return mosaic


@dataclass(frozen=True)
class ArrayFormat:
    """The format of the arrays of a sample.

    Args:
        dtype: the type of images and raws, one of :data:`DTYPES`. None is uint8 for display values,
            uint16 for raws, and float32 for the rest.
        channels_first: whether images are (channel, height, width).
        raw: the layout of raws. None means no raws.
    """

    dtype: str | None = None
    channels_first: bool = False
    raw: RawForm | None = None

    @property
    def is_in_dn(self) -> bool:
        """Whether raws are in DN, not scaled to signal."""
        return self.dtype in (None, "uint16")

    def check(self, kind: Kind) -> None:
        """Check that the type can hold the last image of a chain.

        Raises:
            RequestError: it cannot.
        """
        if self.dtype == "uint16" and kind not in (Kind.DISPLAY, Kind.RAW):
            raise RequestError(
                "dtype uint16: it holds display values (65535 is white) and DN, but the chain ends "
                f"in {kind.label}, with values below 0 and above 1. Use float16 or float32"
            )
        if self.dtype == "float16" and kind is Kind.RAW:
            raise RequestError(
                "dtype float16: it cannot hold DN exactly, in which the chain ends. Use uint16 or "
                "float32, or end the chain with normalize"
            )

    def check_size(self, width: int, height: int) -> None:
        """Check that the raw of a whole picture can be packed, if requested.

        Raises:
            ImageError: it cannot.
        """
        if self.raw == "packed" and (width % 2 or height % 2):
            raise ImageError(
                f"its picture has {width}x{height} pixels, but a packed raw needs even width and "
                "height. Use patches, or raw='mosaic'"
            )

    def picture(self, image: Array, kind: Kind) -> Array:
        """Convert the last image of a chain, (height, width[, channel]), for a sample."""
        if self.dtype == "uint16" and kind is Kind.DISPLAY:
            image = image * np.float32(HIGHEST)
        return self.ordered(self._typed(image, self.dtype))

    def mosaic(self, mosaic: Array, pattern: str) -> Array:
        """Convert a raw, (height, width) in DN or in signal, for a sample."""
        mosaic = self._typed(mosaic, self.dtype or "uint16")
        return packed(mosaic, pattern) if self.raw == "packed" else mosaic

    def variance(self, variance: Array, pattern: str) -> Array:
        """Convert a variance of each pixel, (height, width), for a sample: float32."""
        variance = packed(variance, pattern) if self.raw == "packed" else variance
        return np.require(variance, requirements=("C", "W"))

    def ordered(self, image: Array) -> Array:
        """Return an image, (height, width[, channel]), in the order of axes; C-contiguous."""
        first = self.channels_first and image.ndim == 3
        return np.ascontiguousarray(image.transpose(2, 0, 1) if first else image)

    @staticmethod
    def _typed(image: Array, dtype: str | None) -> Array:
        if dtype is None:
            return image
        if dtype == "uint16":
            image = np.clip(np.rint(image), 0, HIGHEST)
        return image.astype(dtype, copy=False)
