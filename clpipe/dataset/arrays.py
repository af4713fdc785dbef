"""How the arrays of a sample look: their type, their order, and the planes of a raw. Pure."""

from dataclasses import dataclass
from typing import Any, Literal

import numpy as np

from clpipe.base.errors import ImageError, RequestError
from clpipe.base.text import one_of
from clpipe.base.types import Array
from clpipe.reference.cfa import sites
from clpipe.stage import Kind

DTYPES = ("float16", "float32", "uint16")
HIGHEST = 65535  # of uint16

RawForm = Literal["packed", "mosaic"]


def dtype_named(dtype: Any) -> str | None:
    """The name of a type of :data:`DTYPES`, from all that NumPy takes for one; None stays None.

    Raises:
        RequestError: it is another one, or none.
    """
    if dtype is None:
        return None
    try:
        name = np.dtype(dtype).name
    except TypeError:
        name = str(dtype)
    if name not in DTYPES:
        raise RequestError(one_of("dtype", name, DTYPES))
    return name


def packed(mosaic: Array, pattern: str) -> Array:
    """A mosaic of even height and width as planes: (4, height / 2, width / 2) in R, Gr, Gb, B.

    Gr is green in the rows of red.

    >>> packed(np.array([[1, 2], [3, 4]]), "GRBG").ravel().tolist()
    [2, 1, 4, 3]
    """
    return np.stack([mosaic[site] for site in sites(pattern).values()])


def unpacked(planes: Array, pattern: str) -> Array:
    """The mosaic of planes, as :func:`packed` makes them.

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
    """How the arrays of a sample look.

    Args:
        dtype: of pictures and raws, one of :data:`DTYPES`; None is uint8 for display values,
            uint16 for raws, and float32 for the rest.
        channels_first: whether pictures are (channel, height, width).
        raw: how raws look; None is that there are none.
    """

    dtype: str | None = None
    channels_first: bool = False
    raw: RawForm | None = None

    @property
    def is_in_dn(self) -> bool:
        """Whether raws are in DN, not in signal."""
        return self.dtype in (None, "uint16")

    def check(self, kind: Kind) -> None:
        """See that the last image of a chain can be of the type.

        Raises:
            RequestError: it cannot.
        """
        if self.dtype == "uint16" and kind not in (Kind.DISPLAY, Kind.RAW):
            raise RequestError(
                f"dtype uint16: the chain ends in {kind.label}, which has values below 0 and "
                "above 1; it holds display values (65535 is white) and DN. Use float16 or float32"
            )
        if self.dtype == "float16" and kind is Kind.RAW:
            raise RequestError(
                "dtype float16: the chain ends in DN, which it does not hold exactly; use uint16 "
                "or float32, or end the chain with normalize"
            )

    def check_size(self, width: int, height: int) -> None:
        """See that the raw of a whole picture can be packed, if it is.

        Raises:
            ImageError: it cannot.
        """
        if self.raw == "packed" and (width % 2 or height % 2):
            raise ImageError(
                f"its picture has {width}x{height} pixels, an odd width or height, and a packed "
                "raw has planes of half the size; cut patches, or say raw='mosaic'"
            )

    def picture(self, image: Array, kind: Kind) -> Array:
        """The last image of a chain, (height, width[, channel]), as a sample has it."""
        if self.dtype == "uint16" and kind is Kind.DISPLAY:
            image = image * np.float32(HIGHEST)
        return self.ordered(self._typed(image, self.dtype))

    def mosaic(self, mosaic: Array, pattern: str) -> Array:
        """A raw, (height, width) in DN or in signal, as a sample has it."""
        mosaic = self._typed(mosaic, self.dtype or "uint16")
        return packed(mosaic, pattern) if self.raw == "packed" else mosaic

    def variance(self, variance: Array, pattern: str) -> Array:
        """A variance of each pixel, (height, width), as a sample has it: float32."""
        variance = packed(variance, pattern) if self.raw == "packed" else variance
        return np.require(variance, requirements=("C", "W"))

    def ordered(self, image: Array) -> Array:
        """An image, (height, width[, channel]), in the order of its channels; C-contiguous."""
        first = self.channels_first and image.ndim == 3
        return np.ascontiguousarray(image.transpose(2, 0, 1) if first else image)

    @staticmethod
    def _typed(image: Array, dtype: str | None) -> Array:
        if dtype is None:
            return image
        if dtype == "uint16":
            image = np.clip(np.rint(image), 0, HIGHEST)
        return image.astype(dtype, copy=False)
