"""Reads the image size from a file's header, and estimates the memory to read its pixels."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from clpipe.base.errors import ImageError
from clpipe.images.clip_frames import clip_of, clip_size
from clpipe.images.colour import CIE_XYZ, SRGB, to_linear_srgb
from clpipe.images.colour_names import space_of
from clpipe.images.layers import find_picture, picture_channels
from clpipe.images.openexr import MAX_EXTRA
from clpipe.images.openimageio import open_image
from clpipe.images.raw import RAW_SUFFIXES, raw_size
from clpipe.images.samples import LARGE_CUBE, STRIP
from clpipe.images.spectral import spectra_in

FLOAT = 4  # bytes per float


@dataclass(frozen=True)
class MemoryClaim:
    """The size in a file's header, and estimates of the memory for its image and to read it.

    The model follows :mod:`clpipe.images.read`. This table compares it with measurements at 24 MP,
    in bytes per pixel:

    | file | measured | model |
    |---|---|---|
    | EXR, R, G and B in half | 6.1 | 6 |
    | the same in float | 12.1 | 12 |
    | with alpha | 8.0 | 14 |
    | with other layers | 13.1 | 18 |
    | with other primaries | 24.1 | 24 |
    | with another display window | 11.9 | 12 |
    | TIFF, HDR, JPEG, PNG | 24.0 | 24 |
    | raw | 9 | 12 |

    Args:
        width, height: the larger of data window and display window, in px.
        image: bytes of the image in memory.
        reading: the largest number of bytes while it is read.
    """

    width: int
    height: int
    image: int
    reading: int

    @property
    def megapixels(self) -> float:
        """The size in megapixels."""
        return self.width * self.height / 1e6


def mosaic_claim(width: int, height: int) -> MemoryClaim:
    """Return the claim of a mosaic that is read in whole numbers and converted to floats."""
    return MemoryClaim(width, height, width * height * FLOAT, width * height * 3 * FLOAT)


def display_size(path: Path) -> tuple[int, int]:
    """Return the width and height in px of the picture that a file claims.

    Raises:
        ImageError: it cannot be opened.
    """
    if clip := clip_of(path):
        return clip_size(clip)
    with open_image(path) as file:
        spec = file.spec()
        return spec.full_width, spec.full_height


def claim_of(path: Path, mosaic: bool = False, layer: str | None = None) -> MemoryClaim | None:
    """Return the claim of a file; None if it cannot be opened.

    Args:
        path: the file.
        mosaic: whether only a single channel is read.
        layer: the layer to read, which may be :data:`clpipe.images.spectral.SPECTRAL`.
    """
    try:
        if clip := clip_of(path):
            width, height = clip_size(clip)
            pixels = width * height * 3 * FLOAT
            return MemoryClaim(width, height, pixels, 2 * pixels)
        if path.suffix.lower() in RAW_SUFFIXES:
            return mosaic_claim(*raw_size(path))
        with open_image(path) as file:
            if not mosaic and (layer or spectra_in(file.spec().channelnames)):
                location = find_picture(path, file, mosaic, layer)
                if location.wavelengths:
                    return _cube_claim(file.spec(), location.channels)
                file.seek_subimage(0, 0)
            return _claim(file.spec(), file.format_name() == "openexr", mosaic)
    except ImageError:
        return None


def bands_in(path: Path, layer: str | None) -> tuple[float, ...]:
    """Return the wavelengths of the bands that are read of a file, nm; () if there are none."""
    try:
        if clip_of(path) or path.suffix.lower() != ".exr" or not path.exists():
            return ()
        with open_image(path) as file:
            return find_picture(path, file, False, layer).wavelengths
    except (ImageError, OSError):
        return ()  # reading the image says why


def _cube_claim(spec: Any, channels: Sequence[int]) -> MemoryClaim:
    """Return the claim of a spectral cube, which may be read to disk."""
    width, height = max(spec.width, spec.full_width), max(spec.height, spec.full_height)
    formats = spec.channelformats or [spec.format] * spec.nchannels
    samples = width * height * len(channels)
    size = samples * max(formats[i].size() for i in channels)
    if samples > LARGE_CUBE:
        size = STRIP * FLOAT
    return MemoryClaim(width, height, size, 2 * size)


def _claim(spec: Any, is_exr: bool, mosaic: bool) -> MemoryClaim:
    width, height = max(spec.width, spec.full_width), max(spec.height, spec.full_height)
    formats = spec.channelformats or [spec.format] * spec.nchannels
    picture = None if mosaic else picture_channels(list(spec.channelnames))
    picture_formats = [formats[i] for i in picture[1]] if picture else formats
    sample = 2 if is_exr and all(each.size() == 2 for each in picture_formats) else FLOAT
    image = sample * (1 if mosaic else 3)
    stored = sum(each.size() for each in formats)
    # The package OpenEXR decodes all channels, from which the requested ones are copied.
    extra = 0 if stored == image else min(stored, MAX_EXTRA * image)
    reading = image + (extra if is_exr else image)
    window = spec.x, spec.y, spec.width, spec.height
    if window != (spec.full_x, spec.full_y, spec.full_width, spec.full_height):
        reading = max(reading, 2 * image)
    if not mosaic and _is_converted(spec, bool(picture)):
        reading, image = max(reading, image + 3 * FLOAT), 3 * FLOAT
    pixels = width * height
    return MemoryClaim(width, height, pixels * image, pixels * reading)


def _is_converted(spec: Any, has_picture: bool) -> bool:
    """Return whether the picture has other primaries than sRGB, or is encoded."""
    stated, neutral = spec.getattribute("chromaticities"), spec.getattribute("adoptedNeutral")
    try:
        space, _ = space_of(spec)
        if space and space.encoding:
            return True
        stated = stated or (space and space.chromaticities)
        if has_picture and stated is None and neutral is None:
            return False
        return to_linear_srgb(stated or (SRGB if has_picture else CIE_XYZ), neutral) is not None
    except ImageError:
        return False
