"""Small 8-bit pictures for notebooks and reports."""

import io
import tempfile
from functools import cache
from pathlib import Path

import numpy as np
from PIL import Image

from clpipe.base.errors import ImageError
from clpipe.base.types import Array
from clpipe.images.read import read_image
from clpipe.images.samples import holds_mosaic
from clpipe.reference.curve import to_8_bit
from clpipe.reference.transfer import srgb_curve
from clpipe.stage import Kind

# Exceptions that Pillow raises for damaged files, and for files that claim to be very large.
PILLOW_ERRORS = (OSError, ValueError, SyntaxError, Image.DecompressionBombError)


def png_bytes(pixels: Array) -> bytes:
    """Return a PNG of an image. Images above 1024 px keep every second, third, ... pixel.

    Args:
        pixels: (height, width) or (height, width, 3), uint8, or floats from 0 (black) to 1 (white).

    >>> png_bytes(np.zeros((2, 3), np.float32))[:4]
    b'\\x89PNG'
    """
    step = -(-max(pixels.shape[:2]) // 1024)
    small = np.ascontiguousarray(pixels[::step, ::step])
    picture = Image.fromarray(small if small.dtype == np.uint8 else to_8_bit(small))
    file = io.BytesIO()
    picture.save(file, "PNG")
    return file.getvalue()


def jpeg_bytes(pixels: Array, quality: int = 93) -> bytes:
    """Return a JPEG of (height, width, 3) uint8, without chroma subsampling."""
    file = io.BytesIO()
    Image.fromarray(pixels).save(file, "JPEG", quality=quality, subsampling=0)
    return file.getvalue()


def thumbnail(file: Path | io.BytesIO, name: str, side: int) -> Image.Image:
    """Return an 8-bit picture, reduced to at most ``side`` pixels in width and height.

    Raises:
        ImageError: it cannot be read; the message contains its name.
    """
    try:
        with Image.open(file) as picture:
            picture.draft("RGB", (2 * side, 2 * side))
            small = picture.convert("RGB")
            small.thumbnail((side, side), Image.Resampling.LANCZOS)
            return small
    except PILLOW_ERRORS as error:
        raise ImageError(f"{name}: cannot be shown: {error}") from None


def thumbnail_bytes(data: bytes, name: str, side: int) -> bytes:
    """Return a small WebP of a picture, at most ``side`` pixels wide and high.

    Args:
        data: the bytes of its file; see :func:`decode_8_bit`.
        name: the name of the file.
        side: the largest width and height in px.

    Raises:
        ImageError: it cannot be read.
    """
    if name.endswith(".jpg"):
        small = thumbnail(io.BytesIO(data), name, side)
    else:
        small = Image.fromarray(decode_8_bit(data, name))
        small.thumbnail((side, side), Image.Resampling.LANCZOS)
    file = io.BytesIO()
    small.save(file, "WEBP", quality=75)
    return file.getvalue()


def decode_8_bit(data: bytes, name: str) -> Array:
    """Return a picture with 8 bits per channel, (height, width, 3).

    Linear light is encoded with sRGB's curve. So are mosaics, whose brightest sample becomes white.

    Args:
        data: the bytes of a JPEG, PNG, TIFF, OpenEXR or ``.npy`` that clpipe wrote.
        name: the name of the file, for its extension and for messages.

    Raises:
        ImageError: the picture cannot be read, or is of another kind.
    """
    try:
        if name.endswith(".exr"):
            return _decode_exr(data)
        if name.endswith(".npy"):
            array = np.load(io.BytesIO(data), allow_pickle=False)
            return _to_8_bit_rgb(array, np.issubdtype(array.dtype, np.float16))
        with Image.open(io.BytesIO(data)) as picture:
            return np.asarray(picture.convert("RGB"))
    except ImageError as error:
        raise ImageError(f"{name}: {str(error).partition(': ')[2]}") from None
    except PILLOW_ERRORS as error:
        raise ImageError(f"{name}: cannot be shown: {error}") from None


def reduce(pixels: Array, by: int) -> Array:
    """Return (height, width, 3) uint8 in which each pixel is the mean of ``by`` x ``by`` pixels.

    >>> reduce(np.uint8([[[0, 0, 9], [2, 0, 9], [4, 4, 4]]]), 2).tolist()
    [[[1, 0, 9], [4, 4, 4]]]
    """
    return np.asarray(Image.fromarray(pixels).reduce(by)) if by > 1 else pixels


@cache
def _light_table() -> Array:
    """Return a table from the bits of a half float (linear light) to 8 bits on sRGB's curve."""
    halves = np.arange(1 << 16, dtype=np.uint16).view(np.float16).astype(np.float64)
    light = np.clip(np.nan_to_num(halves, posinf=1, neginf=0), 0, 1)
    return to_8_bit(srgb_curve(light).astype(np.float32))


def light_to_srgb(image: Array) -> Array:
    """Return linear light from 0 (black) to 1 (white) as 8 bits on sRGB's curve, via half floats.

    >>> light_to_srgb(np.float32([[-1, 0, 0.5, 1, 9]])).tolist()
    [[0, 0, 188, 255, 255]]
    """
    with np.errstate(over="ignore"):
        return _light_table()[image.astype(np.float16).view(np.uint16)]


def _decode_exr(data: bytes) -> Array:
    with tempfile.NamedTemporaryFile(suffix=".exr") as file:
        file.write(data)
        file.flush()
        path = Path(file.name)
        image = read_image(path, holds_mosaic(path))
    return _to_8_bit_rgb(image.pixels, image.attributes.get("kind") == Kind.DISPLAY.label)


def _to_8_bit_rgb(array: Array, is_display: bool) -> Array:
    """Return an image with 8 bits per channel; see :func:`decode_8_bit`."""
    if array.ndim not in (2, 3) or (array.ndim == 3 and array.shape[2] != 3):
        raise ValueError(f"its shape is {array.shape}, but a picture has 3 channels, a mosaic none")
    values = np.nan_to_num(array.astype(np.float64))
    if array.ndim == 2:
        values = np.stack([values / max(float(values.max(initial=0)), 1e-9)] * 3, axis=-1)
    light = np.clip(values, 0, 1)
    return to_8_bit((light if is_display else srgb_curve(light)).astype(np.float32))
