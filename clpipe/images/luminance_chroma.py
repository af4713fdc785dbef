"""Reads OpenEXR files with luminance and subsampled chroma."""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from clpipe.base.errors import ImageError
from clpipe.base.text import printable
from clpipe.base.types import Array, Floats
from clpipe.images.colour import SRGB, rgb_to_xyz
from clpipe.images.openexr import open_exr
from clpipe.images.openimageio import error_text
from clpipe.images.pixels import check_size

CHANNELS = ("Y", "RY", "BY")
MAX_CHANNELS = 8  # channels in all parts: luminance, chroma, alpha, depth and a few more


@dataclass(frozen=True)
class DataWindow:
    """The data window of a file, and its place in the display window.

    Args:
        pixels: RGB, (rows, columns, 3) float32.
        x, y: column and row of its upper left pixel in the display window.
        width, height: size of the display window in px.
        attributes: the file's header.
    """

    pixels: Floats
    x: int
    y: int
    width: int
    height: int
    attributes: Mapping[str, Any]


def read_luminance_chroma(path: Path, max_pixels: int) -> DataWindow:
    """Return the data window of an EXR with subsampled chroma, which OpenImageIO cannot read.

    Raises:
        ImageError: the file is damaged, too large, deep, or has other subsampled channels.
    """

    def read(header_only: bool) -> tuple[Any, Any]:
        """Return the first part, and all parts."""
        try:
            parts = open_exr(path, header_only).parts
            return parts[0], parts
        except Exception as error:  # the C++ library raises many types of exceptions
            raise ImageError(f"{path}: damaged: {error_text(str(error))}") from None

    first, parts = read(header_only=True)
    header = first.header
    names = sorted(channel.name for channel in header["channels"])
    is_flat = all(part.header["type"].name == "scanlineimage" for part in parts)
    if not set(CHANNELS) <= set(names) or not is_flat:
        raise ImageError(
            f"{path}: this file has subsampled channels {printable(', '.join(names))}, but clpipe "
            f"reads only {', '.join(CHANNELS)}. Write the picture as R, G and B"
        )
    (left, top), (right, bottom) = (corner.tolist() for corner in header["dataWindow"])
    (x, y), (x_end, y_end) = (corner.tolist() for corner in header["displayWindow"])
    size, picture = (right - left + 1, bottom - top + 1), (x_end - x + 1, y_end - y + 1)
    for width, height in (size, picture):
        check_size(path, width, height, max_pixels)
    # OpenEXR reads all parts and channels.
    if sum(_samples(part.header) for part in parts) > MAX_CHANNELS * max_pixels:
        raise ImageError(
            f"{path}: its parts and channels have more samples than {MAX_CHANNELS} channels of "
            f"{max_pixels} pixels. To read more, set --max-pixels"
        )
    channels = read(header_only=False)[0].channels
    luminance, red, blue = (channels[name] for name in CHANNELS)
    planes = luminance.pixels, red.pixels, blue.pixels
    sampling = [(c.xSampling, c.ySampling) for c in (luminance, red, blue)]
    half = tuple((n + 1) // 2 for n in size[::-1])
    shapes = [plane.shape for plane in planes]
    if sampling != [(1, 1), (2, 2), (2, 2)] or shapes != [size[::-1], half, half]:
        raise ImageError(
            f"{path}: its chroma is not subsampled by 2, the only factor that clpipe reads. Write "
            "the picture as R, G and B"
        )
    weights = rgb_to_xyz(header.get("chromaticities", SRGB))[1]
    return DataWindow(to_rgb(*planes, weights), left - x, top - y, *picture, header)


def _samples(header: Mapping[str, Any]) -> int:
    """Return the largest possible number of samples in a part."""
    (left, top), (right, bottom) = (corner.tolist() for corner in header["dataWindow"])
    return max(right - left + 1, 0) * max(bottom - top + 1, 0) * len(header["channels"])


def to_rgb(luminance: Array, red: Array, blue: Array, weights: Array) -> Floats:
    """Return RGB, (height, width, 3) float32, from luminance and subsampled chroma.

    RY = (R - Y) / Y and BY = (B - Y) / Y (OpenEXR, ImfRgbaYca.h) are stored for even rows and
    columns, and interpolated linearly, which creates no new extremes of colour.

    Args:
        luminance: Y, (height, width).
        red: RY at every second row and column.
        blue: BY at every second row and column.
        weights: the luminances of red, green and blue.
    """
    y = luminance.astype(np.float32)
    wr, wg, wb = (np.float32(weight) for weight in weights)
    with np.errstate(all="ignore"):  # the file may hold infinity
        r, b = ((upsample(plane, y.shape) + 1) * y for plane in (red, blue))
        return np.stack([r, (y - wr * r - wb * b) / wg, b], axis=-1)


def upsample(plane: Array, shape: tuple[int, ...]) -> Floats:
    """Return a plane upsampled by 2 with linear interpolation, cropped to ``shape``.

    >>> upsample(np.array([[0, 1]]), (1, 4)).tolist()
    [[0.0, 0.5, 1.0, 1.0]]
    """
    for axis, size in enumerate(shape):
        narrow = np.moveaxis(plane.astype(np.float32), axis, 0)
        wide = np.repeat(narrow, 2, axis=0)
        wide[1:-1:2] = (narrow[:-1] + narrow[1:]) / 2
        plane = np.moveaxis(wide[:size], 0, axis)
    return plane
