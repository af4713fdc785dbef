"""Image files in and out. The only importer of OpenImageIO and Pillow."""

import contextlib
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import OpenImageIO as oiio
from numpy.typing import NDArray

from clpipe.base.errors import ImageError
from clpipe.base.files import sha256_of
from clpipe.base.text import printable
from clpipe.base.types import Array
from clpipe.images.colour import CIE_XYZ, SRGB, to_linear_srgb
from clpipe.images.layers import _find_picture, _Picture, mosaic_channel, picture_channels
from clpipe.images.luminance_chroma import read_luminance_chroma
from clpipe.images.tags import _attributes, shot_of
from clpipe.reference.transfer import inverse_srgb_curve
from clpipe.stage import Kind

RENDER_SUFFIXES = (".exr", ".hdr", ".pfm", ".tif", ".tiff")
PICTURE_SUFFIXES = (".jpg", ".jpeg", ".png", ".tif", ".tiff", ".exr")
HALF_MAX = np.float32(65504)  # so bright that nothing is lost, and no square overflows
MAX_PIXELS = 1_000_000_000  # what a device is ever given
USUAL_MAX_PIXELS = 200_000_000  # what a file may claim, where nobody says otherwise


@dataclass(frozen=True)
class SourceImage:
    """An image as it came from a file.

    ``pixels`` is (height, width, 3) linear RGB or a (height, width) mosaic, float16 or float32,
    finite and C-contiguous. ``attributes`` are those that clpipe gives to a kept image, ``shot``
    what the file says of exposure_time (s), focal_length and sensor_width (mm).
    """

    pixels: Array
    sha256: str
    layer: str
    warnings: tuple[str, ...]
    attributes: Mapping[str, str]
    shot: Mapping[str, float] = field(default_factory=dict)


def set_codec_threads(count: int) -> None:
    """How many threads the reading or writing of one file may take."""
    oiio.attribute("threads", count)
    oiio.attribute("exr_threads", count)


def read_image(
    path: Path,
    mosaic: bool = False,
    layer: str | None = None,
    max_pixels: int = USUAL_MAX_PIXELS,
) -> SourceImage:
    """Read the picture of a file as linear sRGB: the display window, everything finite.

    R, G and B are found by name; else X, Y and Z; else luminance alone is grey. Other primaries
    than those of sRGB are converted. Half stays half where nothing is. Alpha, depth and other
    layers are left alone. NaN and infinity become 0, counted in a warning. What the data window
    leaves out of the display window is black.

    Args:
        path: the file.
        mosaic: read a single channel instead, which may hold whole numbers of 16 or 32 bits.
        layer: the layer or part that is the picture; None chooses (:data:`PICTURE_LAYERS`).
        max_pixels: a file that claims more is refused before memory is taken.

    Raises:
        ImageError: the file is missing, empty, damaged, no image, not linear float, deep, a cube
            map or texture, too large, or has not the channels or the layer; the message names the
            file and the reason.
    """
    try:
        with _opened(path) as (digest, file):
            picture = _find_picture(path, file, mosaic, layer)
            spec, pixels = file.spec(), _read_part(path, file, picture, mosaic, max_pixels)
        chromaticities = CIE_XYZ if picture.xyz else spec.getattribute("chromaticities")
        neutral = spec.getattribute("adoptedNeutral")
        attributes, name, shot = _attributes(spec), picture.layer, shot_of(spec)
    except SubsampledError:
        if mosaic or layer is not None:
            raise
        window = read_luminance_chroma(path, max_pixels)
        pixels = display_window(window.pixels, window.x, window.y, window.width, window.height)
        (digest, _), attributes, name, shot = sha256_of(path), {}, "", {}
        chromaticities = window.attributes.get("chromaticities")
        neutral = window.attributes.get("adoptedNeutral")
    warnings = []
    pixels, count = without_non_finite(pixels)
    if count:
        warnings.append(f"{count} samples were NaN or infinite and were set to 0")
    if pixels.ndim == 2 and not mosaic:
        pixels = np.stack([pixels] * 3, axis=-1)
        warnings.append("it holds luminance alone; the picture is grey")
    elif not mosaic:
        matrix = None
        try:
            if chromaticities is not None or neutral is not None:
                matrix = to_linear_srgb(SRGB if chromaticities is None else chromaticities, neutral)
        except ImageError as error:
            raise ImageError(f"{path}: {error}") from None
        if matrix is not None:
            with np.errstate(all="ignore"):  # what overflows is clipped below
                pixels = np.nan_to_num(pixels.astype(np.float32) @ matrix.T)
            warnings.append("its colours were converted to linear sRGB")
    if (
        not mosaic
        and pixels.dtype == np.float32
        and (beyond := int((np.abs(pixels) > HALF_MAX).sum()))
    ):
        pixels = np.clip(pixels, -HALF_MAX, HALF_MAX)
        warnings.append(f"{beyond} samples beyond {HALF_MAX:g}, the range of half, were clipped")
    return SourceImage(pixels, digest, name, tuple(warnings), attributes, shot)


def decode_alone(path: Path) -> Array:
    """The samples of a file's first part, (height, width, channel), as they are; for measuring."""
    file = oiio.ImageInput.open(str(path))
    assert file
    with contextlib.closing(file):
        return np.asarray(file.read_image(file.spec().format))


TRANSFERS: dict[str, Callable[[NDArray[np.float64]], NDArray[np.float64]]] = {
    "linear": lambda x: x,
    "srgb": inverse_srgb_curve,
}


@dataclass(frozen=True)
class ReadOptions:
    """How files are read, where that is not left to them.

    ``layer`` and ``max_pixels`` are those of :func:`read_image`. ``transfer`` is that of renders in
    whole numbers (PNG, TIFF), one of :data:`TRANSFERS`; None refuses them.
    """

    layer: str | None = None
    max_pixels: int = USUAL_MAX_PIXELS
    transfer: str | None = None


def read_source(path: Path, kind: Kind, how: ReadOptions) -> SourceImage:
    """The image of a file, as a chain that starts on this kind wants it.

    Raises:
        ImageError: it cannot be read, or holds another kind.
    """
    if kind is Kind.RGB and how.transfer and (whole := read_finished(path)):
        linear = TRANSFERS[how.transfer](whole.pixels.astype(np.float64))
        return replace(whole, pixels=linear.astype(np.float32))
    if kind is not Kind.DISPLAY:
        return read_image(path, len(kind.channels) == 1, how.layer, how.max_pixels)
    finished = read_finished(path)
    if finished is None:
        finished = read_image(path, False, how.layer, how.max_pixels)
        if finished.attributes.get("kind") != kind.label:
            raise ImageError(
                f"{path}: holds linear light, but the chain starts on finished pictures "
                "(JPEG, PNG or TIFF, 8 or 16 bits)"
            )
    return finished


def read_finished(path: Path) -> SourceImage | None:
    """A finished picture (JPEG, PNG, TIFF), (height, width, 3), 0..1, as it is encoded.

    None if the file holds no red, green and blue in whole numbers of 8 or 16 bits, and so is for
    :func:`read_image`. Alpha is left alone.

    Raises:
        ImageError: the file is missing, empty, damaged or no image.
    """
    with _opened(path) as (digest, file):
        spec = file.spec()
        picture = picture_channels(list(spec.channelnames))
        if picture is None or spec.format.basetype not in (oiio.UINT8, oiio.UINT16):
            return None
        pixels = file.read_image(oiio.FLOAT)  # scales whole numbers to 0..1
        problem = file.geterror()
        if pixels is None or problem:
            raise ImageError(f"{path}: damaged: {_reason(problem)}")
        rgb = np.ascontiguousarray(np.asarray(pixels)[..., list(picture[1])])
        return SourceImage(rgb, digest, "", (), {})


def holds_mosaic(path: Path) -> bool:
    """Whether a file has no red, green and blue, but one channel that may be a mosaic.

    Raises:
        ImageError: the file is missing, empty, damaged or no image.
    """
    with _opened(path) as (_, file):
        parts: list[list[str]] = []
        while file.seek_subimage(len(parts), 0):
            parts.append(list(file.spec().channelnames))
    return not any(map(picture_channels, parts)) and any(map(mosaic_channel, parts))


@contextlib.contextmanager
def _opened(path: Path) -> Iterator[tuple[str, Any]]:
    """A file's SHA-256, and the file open in OpenImageIO.

    Raises:
        ImageError: the file is missing, empty, or of no known format.
    """
    try:
        str(path).encode()
    except UnicodeEncodeError:
        raise ImageError(f"{str(path)!a}: its name is not UTF-8; rename it") from None
    try:
        digest, size = sha256_of(path)
    except FileNotFoundError:
        raise ImageError(f"{path}: no such file") from None
    except OSError as error:
        raise ImageError(f"{path}: cannot be read: {error.strerror}") from None
    if not size:
        raise ImageError(f"{path}: the file is empty")
    try:
        hints = oiio.ImageSpec()
        hints.attribute("pnm:pfmflip", 1)  # else OpenImageIO 3.2 has PFM upside down
        file = oiio.ImageInput.open(str(path), hints)
        if file is None:
            reason = _reason(oiio.geterror())
            failure = SubsampledError if reason.startswith("Subsampled channels") else ImageError
            raise failure(f"{path}: cannot be read as an image: {reason}")
        with contextlib.closing(file):
            yield digest, file
    except UnicodeDecodeError:  # out of any call that gives text from the file
        raise ImageError(f"{path}: damaged: a name or attribute in it is not UTF-8") from None


def _reason(text: str) -> str:
    """An error of OpenImageIO, in one line."""
    if not text or "could not find a format reader" in text:
        return "it is damaged, or of no known format"
    return printable(text)


class SubsampledError(ImageError):
    """OpenImageIO cannot read a file, for its channels are not all of one size."""


def _read_part(path: Path, file: Any, picture: _Picture, mosaic: bool, max_pixels: int) -> Array:
    """Three channels of one part, or one, in its display window.

    Raises:
        ImageError: they are not linear float (a mosaic may be whole), too many, or damaged.
    """
    spec, channels = file.spec(), picture.channels
    formats = spec.channelformats or [spec.format] * spec.nchannels
    types = {formats[i].basetype for i in channels}
    whole = mosaic and types <= {oiio.UINT16, oiio.UINT32}
    if not whole and not types <= {oiio.HALF, oiio.FLOAT, oiio.DOUBLE}:
        raise ImageError(
            f"{path}: holds {spec.format} samples, not linear float ones; "
            "give an OpenEXR file, or say --transfer linear or srgb; a photograph: -c unprocess"
        )
    width, height = spec.full_width, spec.full_height
    for wide, high in ((width, height), (spec.width, spec.height)):
        if not 0 < wide * high <= max_pixels:
            raise ImageError(f"{path}: {wide}x{high} pixels; at most {max_pixels} are read")
    half = types == {oiio.HALF}
    first, last = min(channels), max(channels) + 1
    # Asked for as float, whole numbers would come scaled to 0..1.
    wanted = types.pop() if whole else oiio.HALF if half else oiio.FLOAT
    data = file.read_image(picture.part, 0, first, last, wanted)
    problem = file.geterror()
    if data is None or problem:
        raise ImageError(f"{path}: damaged: {_reason(problem)}")
    pixels = np.asarray(data).reshape(spec.height, spec.width, last - first)
    if whole:
        pixels = pixels.astype(np.float32)
    order = [i - first for i in channels]
    if order != list(range(last - first)):
        pixels = pixels[..., order]
    x, y = spec.x - spec.full_x, spec.y - spec.full_y
    if (x, y, spec.width, spec.height) != (0, 0, width, height):
        pixels = display_window(pixels, x, y, width, height)
    return np.ascontiguousarray(pixels if len(channels) > 1 else pixels[..., 0])


def display_window(data: Array, x: int, y: int, width: int, height: int) -> Array:
    """The part of a data window, placed at (x, y), that lies in a width x height display window."""
    window = np.zeros((height, width, data.shape[2]), data.dtype)
    left, top = max(x, 0), max(y, 0)
    right, bottom = min(x + data.shape[1], width), min(y + data.shape[0], height)
    if left < right and top < bottom:
        window[top:bottom, left:right] = data[top - y : bottom - y, left - x : right - x]
    return window


def without_non_finite(pixels: Array) -> tuple[Array, int]:
    """The image with 0 for each NaN or infinity, and how many there were."""
    if pixels.dtype == np.float16:
        bits = pixels.view(np.uint16)
        if bits.max() < 0x7C00:  # all are finite, and none is negative
            return pixels, 0
        bad = (bits & 0x7C00) == 0x7C00
    else:
        bad = ~np.isfinite(pixels)
    count = int(np.count_nonzero(bad))
    if count:
        pixels = np.where(bad, pixels.dtype.type(0), pixels)
    return pixels, count
