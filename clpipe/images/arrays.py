"""Arrays as images: converted if their meaning is unambiguous, otherwise rejected with advice."""

from collections.abc import Sequence
from pathlib import PurePath
from typing import Any

import numpy as np

from clpipe.base.errors import ImageError, RequestError
from clpipe.base.memory import release_pages
from clpipe.base.types import Array
from clpipe.stage import Kind

CPU = 1  # DLPack's number of this device
BLOCK = 1 << 24  # samples that are checked at a time


def as_array(value: Any, what: str) -> Array:
    """Return a NumPy array that shares the memory of an array or DLPack tensor of any library.

    An array on a GPU is copied once, if its library can do that.

    Args:
        value: the array or tensor.
        what: its name, for the message.

    Raises:
        ImageError: it is neither, or its memory cannot be shared.
    """
    if isinstance(value, np.ndarray):
        return value
    kind = type(value).__name__
    if hasattr(value, "__array_interface__"):
        return np.asarray(value)
    if not hasattr(value, "__dlpack__"):
        way = f"numpy.asarray({what})" if isinstance(value, list | tuple) else "a NumPy array"
        if isinstance(value, str | PurePath):
            way += ". For files, use clpipe.run or clpipe.Dataset"
        raise ImageError(f"{what} is a {kind}, but an array is expected. Pass {way}")
    if getattr(value, "requires_grad", False):
        raise ImageError(f"{what} is a {kind} with a gradient. Pass {what}.detach()")
    try:
        is_here = value.__dlpack_device__()[0] == CPU
        # NumPy asks the library for a copy, if the memory is that of a GPU.
        return np.from_dlpack(value) if is_here else np.from_dlpack(value, device="cpu")
    except (BufferError, RuntimeError, TypeError, ValueError) as error:
        raise ImageError(
            f"{what} is a {kind} whose memory cannot be shared ({error}). If it is on a GPU, pass "
            f"{what}.cpu()"
        ) from None


def as_stack(value: Any, what: str, **given: Sequence[Any] | None) -> Array:
    """Return a stack of images as an array, (view, height, width[, 3]).

    Args:
        value: the stack, as for :func:`as_array`.
        what: its name, for the message.
        **given: what belongs to each view, by name; None if there is nothing.

    Raises:
        ImageError: it is no stack.
        RequestError: something is not given as often as there are views.
    """
    stack = as_array(value, what)
    if stack.ndim < 3:
        raise ImageError(
            f"{what} has shape {stack.shape}, but a stack of images is expected: "
            "(view, height, width, 3)"
        )
    for name, each in given.items():
        if each is not None and len(each) != len(stack):
            raise RequestError(
                f"found {len(each)} {name}, but the stack has {len(stack)} views; pass one for each"
            )
    return stack


def as_image(value: Any, kind: Kind, bands: int = 0) -> Array:
    """Return an image in a type that a chain can start on: float16, float32 or whole DN.

    Args:
        value: an array or tensor, (height, width, 3), or (height, width) for a mosaic.
        kind: the kind of image that the chain starts on.
        bands: the number of its bands if it is spectral, instead of 3.

    Raises:
        ImageError: the value has another type or shape, or is not finite; the message advises.
    """
    image = as_array(value, "image")
    check_shape(image.shape, kind, bands)
    is_mosaic = len(kind.channels) == 1
    if kind is Kind.DISPLAY and image.dtype in (np.uint8, np.uint16):
        return image.astype(np.float32) / np.float32(np.iinfo(image.dtype).max)
    if image.dtype.kind != "f" and not (is_mosaic and image.dtype in (np.uint16, np.uint32)):
        advice = (
            "For DN, pass image.astype(np.uint16)"
            if is_mosaic
            else "For linear values, pass image / np.float32(WHITE), with the value of white. "
            "For a finished picture, use the configuration 'unprocess'"
        )
        raise ImageError(
            f"the image has samples of type {image.dtype}, but the chain expects "
            f"{kind.label} as floats. {advice}"
        )
    if image.dtype not in (np.float16, np.float32):
        image = image.astype(np.float32)
    if not is_finite(image):
        wrong = np.argwhere(~np.isfinite(image))
        names = ("row", "column", "channel")[: image.ndim]
        place = ", ".join(f"{name} {i}" for name, i in zip(names, wrong[0], strict=True))
        raise ImageError(
            f"the image has {len(wrong)} samples that are NaN or infinite, the first at {place}. "
            "Replace them, for example with np.nan_to_num(image)"
        )
    return image


def is_finite(image: Array) -> bool:
    """Return whether all samples are finite. The image may be larger than half of the memory."""
    if image.size <= BLOCK:
        return bool(np.isfinite(image).all())
    halves = np.array_split(image, 2, axis=int(np.argmax(image.shape[:2])))
    found = all(map(is_finite, halves))
    release_pages(image)
    return found


def check_shape(shape: tuple[int, ...], kind: Kind, bands: int = 0) -> None:
    """Check that an array has the shape of one image of a kind.

    Raises:
        ImageError: it has not; the message contains code that converts it.
    """
    channels = bands or len(kind.channels)
    expected = f"(height, width, {channels})" if channels > 1 else "(height, width)"
    last = () if channels == 1 else (channels,)
    if 0 not in shape and len(shape) == 2 + len(last) and shape[2:] == last:
        return
    advice = ""
    if bands:
        advice = f"The last axis has the {bands} bands of render.wavelengths"
    elif channels == 1 and len(shape) == 3 and 1 in (shape[0], shape[2]):
        advice = f"Pass {'image[0]' if shape[0] == 1 else 'image[..., 0]'}"
    elif channels == 1 and len(shape) == 3 and shape[2] == 3:
        advice = "To process colours, start the chain at mosaic or before it"
    elif channels > 1 and len(shape) == 3 and shape[2] == 4:
        advice = "To leave out alpha, pass image[..., :3]"
    elif channels > 1 and len(shape) == 3 and shape[0] in (3, 4):
        advice = "Channels are last: pass np.moveaxis(image[:3], 0, -1)"
    elif channels > 1 and (len(shape) == 2 or shape[2:] == (1,)):
        advice = "For a grey image, pass np.repeat(image.reshape(*image.shape[:2], 1), 3, axis=2)"
    elif len(shape) == (4 if channels > 1 else 3):
        advice = "For a batch, use process_many(zip(images, keys))"
    raise ImageError(
        f"the image has shape {shape}, but {expected} is expected{'. ' * bool(advice)}{advice}"
    )
