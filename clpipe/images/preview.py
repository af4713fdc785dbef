"""Pictures to be looked at, in notebooks and in reports: small, or of eight bits."""

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

# What Pillow raises for a file that is damaged, or claims to be very large.
DAMAGED = (OSError, ValueError, SyntaxError, Image.DecompressionBombError)


def png_bytes(pixels: Array) -> bytes:
    """A PNG of an image; larger ones than 1024 pixels keep every second, third, ... pixel.

    Args:
        pixels: (height, width) or (height, width, 3), uint8, or floats that show 0 as black and 1
            as white.

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
    """A JPEG, whose chroma is not subsampled, of (height, width, 3) uint8."""
    file = io.BytesIO()
    Image.fromarray(pixels).save(file, "JPEG", quality=quality, subsampling=0)
    return file.getvalue()


def thumbnail(file: Path | io.BytesIO, name: str, side: int) -> Image.Image:
    """Return a picture of eight bits, made at most ``side`` pixels wide and high.

    Raises:
        ImageError: it cannot be read; the message has its name.
    """
    try:
        with Image.open(file) as picture:
            picture.draft("RGB", (2 * side, 2 * side))
            small = picture.convert("RGB")
            small.thumbnail((side, side), Image.Resampling.LANCZOS)
            return small
    except DAMAGED as error:
        raise ImageError(f"{name}: cannot be shown: {error}") from None


def thumbnail_bytes(data: bytes, name: str, side: int) -> bytes:
    """A small WebP of a picture, at most ``side`` pixels wide and high.

    Args:
        data: the bytes of its file; see :func:`decoded`.
        name: of the file.
        side: in px.

    Raises:
        ImageError: it cannot be read.
    """
    if name.endswith(".jpg"):
        small = thumbnail(io.BytesIO(data), name, side)
    else:
        small = Image.fromarray(decoded(data, name))
        small.thumbnail((side, side), Image.Resampling.LANCZOS)
    file = io.BytesIO()
    small.save(file, "WEBP", quality=75)
    return file.getvalue()


def decoded(data: bytes, name: str) -> Array:
    """A picture as eight bits a channel, (height, width, 3).

    Linear light is encoded by sRGB's curve, and so are mosaics, whose brightest sample is white.

    Args:
        data: the bytes of a JPEG, PNG, TIFF, OpenEXR or ``.npy`` that clpipe wrote.
        name: of the file, for its ending and for messages.

    Raises:
        ImageError: it cannot be read, or is of another kind.
    """
    try:
        if name.endswith(".exr"):
            return _decoded_exr(data)
        if name.endswith(".npy"):
            array = np.load(io.BytesIO(data), allow_pickle=False)
            return _shown(array, np.issubdtype(array.dtype, np.float16))
        with Image.open(io.BytesIO(data)) as picture:
            return np.asarray(picture.convert("RGB"))
    except ImageError as error:
        raise ImageError(f"{name}: {str(error).partition(': ')[2]}") from None
    except DAMAGED as error:
        raise ImageError(f"{name}: cannot be shown: {error}") from None


def reduced(pixels: Array, by: int) -> Array:
    """(height, width, 3) uint8, ``by`` x ``by`` pixels of which become one, their mean.

    >>> reduced(np.uint8([[[0, 0, 9], [2, 0, 9], [4, 4, 4]]]), 2).tolist()
    [[[1, 0, 9], [4, 4, 4]]]
    """
    return np.asarray(Image.fromarray(pixels).reduce(by)) if by > 1 else pixels


@cache
def _light_table() -> Array:
    """Eight bits of linear light by sRGB's curve, by the bits of a half float."""
    halves = np.arange(1 << 16, dtype=np.uint16).view(np.float16).astype(np.float64)
    light = np.clip(np.nan_to_num(halves, posinf=1, neginf=0), 0, 1)
    return to_8_bit(srgb_curve(light).astype(np.float32))


def encoded_light(image: Array) -> Array:
    """Linear light, 0 is black and 1 white, as eight bits by sRGB's curve; half floats are enough.

    >>> encoded_light(np.float32([[-1, 0, 0.5, 1, 9]])).tolist()
    [[0, 0, 188, 255, 255]]
    """
    with np.errstate(over="ignore"):
        return _light_table()[image.astype(np.float16).view(np.uint16)]


def _decoded_exr(data: bytes) -> Array:
    with tempfile.NamedTemporaryFile(suffix=".exr") as file:
        file.write(data)
        file.flush()
        path = Path(file.name)
        image = read_image(path, holds_mosaic(path))
    return _shown(image.pixels, image.attributes.get("kind") == Kind.DISPLAY.label)


def _shown(array: Array, is_display: bool) -> Array:
    """An image as eight bits; see :func:`decoded`."""
    if array.ndim not in (2, 3) or (array.ndim == 3 and array.shape[2] != 3):
        raise ValueError(f"it is an array of shape {array.shape}")
    values = np.nan_to_num(array.astype(np.float64))
    if array.ndim == 2:
        values = np.stack([values / max(float(values.max(initial=0)), 1e-9)] * 3, axis=-1)
    light = np.clip(values, 0, 1)
    return to_8_bit((light if is_display else srgb_curve(light)).astype(np.float32))
