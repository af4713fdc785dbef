"""Reads samples and single values from image files, and computes digests of the files."""

from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from math import prod
from pathlib import Path
from tempfile import NamedTemporaryFile, gettempdir
from typing import Any

import numpy as np
import OpenImageIO as oiio

from clpipe.base.digests import digests, stamp_of
from clpipe.base.errors import ImageError
from clpipe.base.files import sha256_of
from clpipe.base.memory import release_pages
from clpipe.base.system import reserve
from clpipe.base.types import Array
from clpipe.images.layers import PictureLocation, mosaic_channel, picture_channels
from clpipe.images.openexr import read_channels
from clpipe.images.openimageio import damage_text, open_image, parts_of, read_with_pillow
from clpipe.images.pixels import DEFAULT_MAX_PIXELS, check_size, display_window
from clpipe.reference.geometry import Margins

LARGE_FILE = 4 << 20  # bytes; for smaller files, starting a thread takes longer than the SHA-256
WAYS = "For a render, add --transfer srgb or --transfer linear. For a photograph, use -c unprocess"
LARGE_CUBE = 1 << 28  # samples; larger spectral cubes are read to disk
STRIP = 1 << 23  # samples that are read at a time
MAX_CHANNEL_SPAN = 8  # channels; the channels of a picture may be hundreds apart


def read_samples(path: Path, file: Any, part: int, channels: Sequence[int], type_: Any) -> Array:
    """Return channels of a part's data window, (rows, columns, channel), in the given type.

    Raises:
        ImageError: the part is damaged, or a volume.
    """
    spec = file.spec()
    if spec.depth > 1:
        raise ImageError(
            f"{path}: this file is a volume of {spec.depth} images, not a picture. Write each "
            "image to its own file"
        )
    first, last = min(channels), max(channels) + 1
    if last - first > MAX_CHANNEL_SPAN:
        planes = [read_samples(path, file, part, [i], type_) for i in channels]
        return np.concatenate(planes, axis=-1)
    data = file.read_image(part, 0, first, last, type_)
    problem = file.geterror()
    if data is None or problem:
        data = read_with_pillow(path, spec, part, type_)
        if data is None:
            raise ImageError(f"{path}: {damage_text(problem)}")
        data = data[..., first:last]
    pixels = np.asarray(data).reshape(spec.height, spec.width, last - first)
    order = [i - first for i in channels]
    return pixels if order == list(range(last - first)) else pixels[..., order]


def read_to_disk(
    path: Path,
    file: Any,
    location: PictureLocation,
    type_: Any,
    size: tuple[int, int],
    position: tuple[int, int],
) -> Array:
    """Return the bands of a part in a window, as a view of planes in a file without a name.

    Args:
        path: the file, for messages.
        file: the open ``oiio.ImageInput``, at the part.
        location: the bands.
        type_: the type of the samples, half or float.
        size: the width and height of the window. Outside the data, it is 0.
        position: the column and row of the data's upper left pixel in it.

    Raises:
        ImageError: the part is damaged, or the disk is full.
    """
    spec, channels = file.spec(), location.channels
    first, last = min(channels), max(channels) + 1
    dtype = np.dtype(np.float16 if type_ == oiio.HALF else np.float32)
    shape = len(channels), size[1], size[0]
    with NamedTemporaryFile() as scratch:
        try:
            reserve(scratch.file, prod(shape) * dtype.itemsize)
            planes = np.memmap(scratch, dtype, "r+", shape=shape)
        except OSError as error:
            raise ImageError(
                f"{path}: its bands do not fit into {gettempdir()}: {error.strerror}; set TMPDIR "
                "to a folder with more space"
            ) from None
    (x, y), step = position, spec.tile_height or max(1, STRIP // (spec.width * (last - first)))
    columns = slice(max(x, 0), min(x + spec.width, size[0]))
    for row in range(0, spec.height, step):
        top, bottom = spec.y + row, spec.y + min(row + step, spec.height)
        ranges = (top, bottom, spec.z, *([spec.z + 1] if spec.tile_width else []), first, last)
        if spec.tile_width:
            samples = file.read_tiles(location.part, 0, spec.x, spec.x + spec.width, *ranges, type_)
        else:
            samples = file.read_scanlines(location.part, 0, *ranges, type_)
        if samples is None:
            raise ImageError(f"{path}: {damage_text(file.geterror())}")
        samples = samples.reshape(bottom - top, spec.width, last - first)
        rows = slice(max(y + row, 0), min(y + row + bottom - top, size[1]))
        if rows.start < rows.stop:
            inside = samples[rows.start - y - row : rows.stop - y - row]
            inside = inside[:, columns.start - x : columns.stop - x, [c - first for c in channels]]
            planes[:, rows, columns] = inside.transpose(2, 0, 1)
        release_pages(planes)
    return planes.transpose(1, 2, 0)


def read_part(
    path: Path,
    file: Any,
    location: PictureLocation,
    mosaic: bool,
    max_pixels: int,
    margins: Margins,
) -> Array:
    """Return one or three channels of a part in its display window with margins.

    Returns:
        float16 or float32, (height, width[, 3]).

    Raises:
        ImageError: the samples are damaged, too many, or not linear float. A mosaic may also have
            whole numbers.
    """
    spec, channels = file.spec(), location.channels
    formats = spec.channelformats or [spec.format] * spec.nchannels
    types = {formats[i].basetype for i in channels}
    is_integer = mosaic and types <= {oiio.UINT16, oiio.UINT32}
    if not is_integer and not types <= {oiio.HALF, oiio.FLOAT, oiio.DOUBLE}:
        raise ImageError(
            f"{path}: this {file.format_name().upper()} file has samples of type {spec.format}, "
            "but linear light in floats is expected",
            WAYS,
        )
    width, height = margins.image_size(spec.full_width, spec.full_height)
    check_size(path, width, height, max_pixels)
    check_size(path, spec.width, spec.height, max_pixels)
    # Whole numbers keep their type, because OpenImageIO would scale them to 0..1 as floats.
    type_ = types.pop() if is_integer else oiio.HALF if types == {oiio.HALF} else oiio.FLOAT
    pixels = None
    position = spec.x - spec.full_x + margins.left, spec.y - spec.full_y + margins.top
    if location.wavelengths and width * height * len(channels) > LARGE_CUBE:
        return read_to_disk(path, file, location, type_, (width, height), position)
    if file.format_name() == "openexr" and not is_integer:
        pixels = read_channels(path, file, channels)
    if pixels is None:
        pixels = read_samples(path, file, location.part, channels, type_)
    if is_integer:
        pixels = pixels.astype(np.float32)
    if (*position, spec.width, spec.height) != (0, 0, width, height):
        pixels = display_window(pixels, *position, width, height)
    return pixels if len(channels) > 1 else np.ascontiguousarray(pixels[..., 0])


def read_whole_numbers(path: Path, colours: bool = False) -> Array:
    """Return the samples of a picture as they are stored, uint8 or uint16.

    They are its first channel, (height, width), or with ``colours`` its first three channels,
    (height, width, 3).

    Raises:
        ImageError: the file cannot be read, holds other samples, or is too large.
    """
    with open_image(path) as file:
        spec = file.spec()
        if spec.format.basetype not in (oiio.UINT8, oiio.UINT16):
            raise ImageError(
                f"{path}: this file has samples of type {spec.format}, but integers of 8 or 16 "
                "bits are expected. Convert it to an 8- or 16-bit PNG or TIFF"
            )
        check_size(path, spec.width, spec.height, DEFAULT_MAX_PIXELS)
        samples = read_samples(path, file, 0, range(3 if colours else 1), spec.format.basetype)
        return samples if colours else samples[..., 0]


def photograph_info(path: Path) -> tuple[float | None, int]:
    """Return the ISO in a finished picture's EXIF, or None, and the number of bits per sample.

    Raises:
        ImageError: the file is missing, empty, damaged or not an image.
    """
    with open_image(path) as file:
        iso = file.spec().getattribute("Exif:PhotographicSensitivity")
        bits = 8 * file.spec().format.size()
    return float(iso) if isinstance(iso, int) and iso > 0 else None, bits


def holds_mosaic(path: Path) -> bool:
    """Return whether a file has no red, green and blue, but one channel that may be a mosaic.

    Raises:
        ImageError: the file is missing, empty, damaged or not an image.
    """
    with open_image(path) as file:
        parts = [list(spec.channelnames) for _, _, spec in parts_of(file)]
    return not any(map(picture_channels, parts)) and any(map(mosaic_channel, parts))


def with_digest(path: Path, read: Callable[[], Array]) -> tuple[Array, str]:
    """Return the array that a function reads from a file, and the file's SHA-256.

    The digest of a large file is computed at the same time, in another thread.

    Raises:
        ImageError: the file cannot be read.
    """
    if stamp_of(path)[0] < LARGE_FILE:
        return read(), digest_of(path)
    with ThreadPoolExecutor(1) as executor:
        digest = executor.submit(digest_of, path)
        return read(), digest.result()


def digest_of(path: Path) -> str:
    """Return the SHA-256 of a file.

    Raises:
        ImageError: it cannot be read.
    """
    try:  # a context manager would take longer, for each image
        return sha256_of(path)[0]
    except OSError as error:
        if digest := digests([str(path)]).get(str(path)):  # a frame of a clip
            return digest
        raise ImageError(f"{path}: cannot be read: {error.strerror}") from None
