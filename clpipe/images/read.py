"""Reading images: renders and kept images as linear light, mosaics, finished pictures."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
import OpenImageIO as oiio

from clpipe.base.cpu_time import CpuTimer
from clpipe.base.errors import ImageError
from clpipe.base.types import Array, Doubles, Floats
from clpipe.images.attributes import clpipe_attributes, photograph_attributes, shot_attributes
from clpipe.images.clip_frames import clip_of, read_clip_frame
from clpipe.images.colour import SRGB, to_linear_srgb
from clpipe.images.colour_names import DECODERS
from clpipe.images.layers import find_picture, picture_channels
from clpipe.images.luminance_chroma import read_luminance_chroma
from clpipe.images.openimageio import SubsampledError, open_image
from clpipe.images.pixels import (
    DEFAULT_MAX_PIXELS,
    HALF_MAX,
    check_size,
    clip_to_half,
    convert_by_rows,
    display_window,
    make_finite,
    overscan_margins,
    windows_overlap,
)
from clpipe.images.samples import WAYS, digest_of, read_part, read_samples, with_digest
from clpipe.images.spectral import SPECTRAL
from clpipe.images.statements import Statements, over_black, read_statements
from clpipe.reference.geometry import NO_MARGINS, Margins
from clpipe.reference.panorama import Panorama
from clpipe.reference.transfer import inverse_srgb_curve
from clpipe.stage import ImageLayer, Kind

RENDER_SUFFIXES = (".exr", ".hdr", ".pfm", ".tif", ".tiff")
PICTURE_SUFFIXES = (".jpg", ".jpeg", ".png", ".tif", ".tiff", ".exr", ".bmp", ".tga", ".webp")
INTEGER_TYPES = (oiio.UINT8, oiio.UINT16, oiio.UINT32, oiio.INT8, oiio.INT16, oiio.INT32)


@dataclass(frozen=True)
class SourceImage:
    """An image that was read from a file.

    Args:
        pixels: linear RGB, (height, width, 3), or a mosaic, (height, width): float16 or float32,
            finite. The array is C-contiguous, or a transposed view of a C-contiguous
            (3, height, width) array.
        sha256: the digest of the file, or of all its files together.
        layer: the name of the layer that was read.
        warnings: sentences about the file.
        attributes: clpipe's own attributes of a kept image, or the tags of a photograph.
        shot: exposure_time (s), focal_length and sensor_width (mm), as far as the file states them.
        subframes: the names and digests of the files that were averaged.
        later: the images of further exposures, shaped like ``pixels``.
        layers: the layers that steps of the chain read, by step.
        margins: the overscan of ``pixels`` and layers.
        envmap: OpenImageIO's name of the environment map that the file states; otherwise "".
        panorama: the panorama, if ``pixels`` is an atlas of several views.
        part: the number of the layer's part in the file, from 0.
        wavelengths: of the bands of a spectral render, nm; ``pixels`` then has a channel for each.
    """

    pixels: Array
    sha256: str
    layer: str
    warnings: tuple[str, ...]
    attributes: Mapping[str, str]
    shot: Mapping[str, float] = field(default_factory=dict)
    subframes: tuple[tuple[str, str], ...] = ()
    later: tuple[Array, ...] = ()
    layers: Mapping[str, ImageLayer] = field(default_factory=dict)
    margins: Margins = NO_MARGINS
    envmap: str = ""
    panorama: Panorama | None = None
    part: int = 0
    wavelengths: tuple[float, ...] = ()


def read_image(
    path: Path,
    mosaic: bool = False,
    layer: str | None = None,
    max_pixels: int = DEFAULT_MAX_PIXELS,
    overscan: bool = False,
) -> SourceImage:
    """Read the picture of a file as linear sRGB, in its display window, with finite samples.

    The picture is the channels R, G and B. Without them it is X, Y and Z, or spectral bands, or
    luminance, which becomes grey. Bands stay as they are. Primaries other than sRGB's are
    converted, and the orientation is applied. Straight alpha multiplies the light, which composites
    the picture over black. Half samples stay half unless they are converted. NaN becomes 0 and
    infinity 65504, with a warning. Pixels outside the data window are black. Warnings list what the
    file states but clpipe does not apply.

    Args:
        path: the file.
        mosaic: whether to read a single channel instead, which may have integers of 16 or 32 bits.
        layer: the layer or part that is the picture; None chooses, see
            :data:`clpipe.images.layers.PICTURE_LAYERS`.
        max_pixels: a file with more pixels is rejected before it is read.
        overscan: whether to read the part of the data window outside the display window as margins.

    Raises:
        ImageError: the file is missing, empty, damaged, not an image, not linear float, deep, a
            texture or too large, or lacks the channels or the layer. The message contains the file
            and the reason.
    """
    try:
        image, stated = _decode(path, mosaic, layer, max_pixels, overscan)
    except SubsampledError:
        if mosaic or layer is not None:
            raise
        image, stated = _decode_luminance_chroma(path, max_pixels, overscan)
    pixels = image.pixels
    warnings = list(stated.warnings_with("linear"))
    values = (("infinite", f"{HALF_MAX:g}, the largest half"), ("NaN or -infinite", "0"))
    for count, (what, to) in zip(make_finite(pixels), values, strict=True):
        if count:
            were = "sample was" if count == 1 else "samples were"
            warnings.append(f"{count} {were} {what} and {were.split()[1]} set to {to}")
    if pixels.ndim == 2 and not mosaic:
        pixels = np.stack([pixels] * 3, axis=-1)
        warnings.append(GREY)
    elif not mosaic and not image.wavelengths:
        pixels, notes = _to_srgb(path, pixels, stated)
        warnings += notes
    # Values above the largest half are so bright that clipping loses nothing. Their squares could
    # overflow.
    if not mosaic and pixels.dtype == np.float32 and (clipped := clip_to_half(pixels)):
        samples = "1 sample" if clipped == 1 else f"{clipped} samples"
        were = "was" if clipped == 1 else "were"
        warnings.append(f"{samples} beyond {HALF_MAX:g}, the range of half, {were} clipped")
    return replace(image, pixels=pixels, warnings=tuple(warnings))


GREY = "the file has only luminance, so the picture is grey"


def _decoded(path: Path, pixels: Array, stated: Statements) -> Array:
    """Return linear light from samples that are encoded as their colour space states.

    Raises:
        ImageError: the samples are no colours.
    """
    space = stated.space
    if space and space.is_data:
        raise ImageError(
            f"{path}: its colour space is {space.name}, so it is no picture. Give a picture; to "
            "carry this file next to one, use --carry"
        )
    if not space or not space.encoding:
        return pixels
    decode = DECODERS[space.encoding]
    return convert_by_rows(lambda rows: decode(rows.astype(np.float64)), pixels)


def _to_srgb(path: Path, light: Array, stated: Statements) -> tuple[Array, list[str]]:
    """Return light in linear sRGB, converted from the file's primaries, and warnings.

    Raises:
        ImageError: the colours that the file states are impossible.
    """
    matrix = _srgb_matrix(path, stated)
    if matrix is None:
        return light, []
    with np.errstate(all="ignore"):  # overflow is clipped later
        converted = convert_by_rows(
            lambda rows: np.nan_to_num(rows.astype(np.float32) @ matrix.T, copy=False), light
        )
    return converted, ["its colours were converted to linear sRGB"]


TRANSFERS: dict[str, Callable[[Doubles], Doubles]] = {
    "linear": lambda x: x,
    "srgb": inverse_srgb_curve,
}


@dataclass(frozen=True)
class ReadOptions:
    """Options for reading files.

    Args:
        layer, max_pixels: see :func:`read_image`.
        transfer: a key of :data:`TRANSFERS`: the encoding of renders in whole numbers (PNG, TIFF
            and others); None rejects them.
        overscan: see :func:`read_image`; only for linear RGB.
    """

    layer: str | None = None
    max_pixels: int = DEFAULT_MAX_PIXELS
    transfer: str | None = None
    overscan: bool = False


def read_source(path: Path, kind: Kind, options: ReadOptions) -> SourceImage:
    """Read a file as the kind of image that a chain starts on.

    Raises:
        ImageError: the file cannot be read, or contains another kind.
    """
    try:
        return _read_source(path, kind, options)
    except ImageError as error:
        raise error.with_way from None


def _read_source(path: Path, kind: Kind, options: ReadOptions) -> SourceImage:
    """Do the same as :func:`read_source`, but without naming options in errors."""
    transfer = options.transfer if kind is Kind.RGB else None
    if transfer and (encoded := _read_encoded(path, options.max_pixels)):
        return _as_light(path, encoded, transfer)
    if kind is not Kind.DISPLAY:
        if clip_of(path):
            raise ImageError(f"{path}: a frame of a clip is no linear light", WAYS)
        mosaic = len(kind.channels) == 1
        overscan = options.overscan and kind is Kind.RGB
        return read_image(path, mosaic, options.layer, options.max_pixels, overscan)
    if finished := read_finished(path, options.max_pixels, grey=True):
        return finished
    image = read_image(path, False, options.layer, options.max_pixels)
    if image.attributes.get("kind") != kind.label:
        raise ImageError(
            f"{path}: this file contains linear light, but the chain starts on finished pictures, "
            "such as a JPEG or PNG. For a render, remove -c unprocess"
        )
    return image


@dataclass(frozen=True)
class _Encoded:
    """A picture in whole numbers: RGB, (height, width, 3), and alpha, both scaled to 0..1."""

    image: SourceImage
    alpha: Floats | None
    stated: Statements
    is_grey: bool


@CpuTimer("decode")
def _read_encoded(path: Path, max_pixels: int) -> _Encoded | None:
    """Return the picture of a file in whole numbers; None if its samples have another type.

    Raises:
        ImageError: as for :func:`read_finished`.
    """
    if clip_of(path):
        frame = read_clip_frame(path, max_pixels)
        pixels = frame.pixels / np.float32(np.iinfo(frame.pixels.dtype).max)
        stated = Statements(frame.chromaticities, warnings=frame.warnings)
        image = SourceImage(pixels, digest_of(path), "", (), {})
        return _Encoded(image, None, stated, is_grey=False)
    with open_image(path) as file:
        spec = file.spec()
        names = list(spec.channelnames)
        picture = picture_channels(names)
        channels = picture[1] if picture else tuple(i for i, n in enumerate(names) if n == "Y")
        if (
            file.format_name() == "openexr"
            or spec.format.basetype not in INTEGER_TYPES
            or not channels
        ):
            return None
        check_size(path, spec.width, spec.height, max_pixels)
        stated = read_statements(path, file)
        has_alpha = 0 <= spec.alpha_channel < spec.nchannels
        indices = (*channels, *([spec.alpha_channel] if has_alpha else []))
        samples = read_samples(path, file, 0, indices, oiio.FLOAT)  # scales whole numbers to 0..1
        rgb = samples[..., : len(channels)]
        rgb = 1 - rgb if stated.is_inverted else rgb
        attributes, shot = photograph_attributes(spec)
        is_grey = len(channels) == 1
        pixels = np.repeat(rgb, 3, axis=-1) if is_grey else np.ascontiguousarray(rgb)
        alpha = np.ascontiguousarray(samples[..., -1]) if has_alpha else None
        image = SourceImage(pixels, digest_of(path), "", (), attributes, shot)
        return _Encoded(image, alpha, stated, is_grey)


def _as_light(path: Path, encoded: _Encoded, transfer: str) -> SourceImage:
    """Return an encoded render as linear sRGB over black.

    Alpha multiplies light, not encoded values. If the alpha channel is associated, encoded values
    are divided by it first.

    Raises:
        ImageError: the colours that the file states are impossible.
    """
    image, alpha, stated = encoded.image, encoded.alpha, encoded.stated
    pixels = image.pixels
    if alpha is not None and stated.is_associated:
        opaque = np.where(alpha > 0, alpha, np.float32(1))[..., np.newaxis]
        pixels = np.minimum(pixels / opaque, 1)
    curve = TRANSFERS[transfer]
    light: Array = convert_by_rows(lambda rows: curve(rows.astype(np.float64)), pixels)
    light, notes = _to_srgb(path, light, stated)
    if alpha is not None:
        light = over_black(light, alpha)
    warnings = (*stated.warnings_with(transfer), *notes, *([GREY] if encoded.is_grey else []))
    attributes = {**image.attributes, "orientation": "1"}
    return replace(image, pixels=stated.upright(light), warnings=warnings, attributes=attributes)


def read_finished(
    path: Path, max_pixels: int = DEFAULT_MAX_PIXELS, grey: bool = False
) -> SourceImage | None:
    """Read a finished picture (JPEG, PNG, TIFF): display values, (height, width, 3), 0..1.

    Alpha is not applied, and there is a warning if a pixel is not opaque.

    Args:
        path: the file.
        max_pixels: see :func:`read_image`.
        grey: whether to read grey pictures, which may also be mosaics.

    Returns:
        The picture; None if the samples are not whole numbers, so that :func:`read_image` applies.

    Raises:
        ImageError: the file is missing, empty, damaged, not an image or too large.
    """
    encoded = _read_encoded(path, max_pixels)
    if encoded is None or (encoded.is_grey and not grey):
        return None
    warnings = [*encoded.stated.warnings_with("srgb"), *([GREY] if encoded.is_grey else [])]
    if _srgb_matrix(path, encoded.stated) is not None:
        warnings.append("its primaries are not those of sRGB; its colours are read as sRGB")
    if encoded.alpha is not None and encoded.alpha.min() < 1:
        warnings.append("its alpha channel is not used")
    return replace(encoded.image, warnings=tuple(warnings))


@CpuTimer("decode")
def _decode(
    path: Path, mosaic: bool, layer: str | None, max_pixels: int, overscan: bool
) -> tuple[SourceImage, Statements]:
    """Return the unconverted picture of a file that OpenImageIO reads, and the file's statements.

    For the arguments and errors, see :func:`read_image`.

    Raises:
        SubsampledError: the channels differ in size.
    """
    with open_image(path) as file:
        location = find_picture(path, file, mosaic, layer)
        spec = file.spec()
        data, display = (spec.width, spec.height), (spec.full_width, spec.full_height)
        x, y = spec.x - spec.full_x, spec.y - spec.full_y
        if not windows_overlap(x, y, data, display):
            raise ImageError(
                f"{path}: no pixel of its data window, {data[0]}x{data[1]} at {spec.x}, {spec.y}, "
                f"lies in its display window, {display[0]}x{display[1]} at {spec.full_x}, "
                f"{spec.full_y}; crop the render inside its frame"
            )
        margins = overscan_margins(x, y, data, display) if overscan else NO_MARGINS
        stated = read_statements(path, file, location.xyz, bool(location.wavelengths))
        pixels, digest = with_digest(
            path, lambda: read_part(path, file, location, mosaic, max_pixels, margins)
        )
        if not mosaic:
            pixels = _decoded(path, stated.light(pixels), stated)
            if stated.alpha >= 0:
                alpha = read_samples(path, file, location.part, [stated.alpha], oiio.FLOAT)
                pixels = over_black(pixels, alpha[..., 0])
            pixels = stated.upright(pixels)
        unread = [
            f"its {each} are not used; to read them, add --layer {SPECTRAL}"
            for each in location.unread
        ]
        stated = replace(stated, warnings=(*unread, *stated.warnings))
        image = SourceImage(
            *(pixels, digest, location.layer, (), clpipe_attributes(spec), shot_attributes(spec)),
            margins=margins,
            envmap=str(spec.getattribute("textureformat") or ""),
            part=location.part,
            wavelengths=location.wavelengths,
        )
        return image, stated


@CpuTimer("decode")
def _decode_luminance_chroma(
    path: Path, max_pixels: int, overscan: bool
) -> tuple[SourceImage, Statements]:
    """Return the picture of a file whose chroma is subsampled; see :func:`_decode`."""
    window = read_luminance_chroma(path, max_pixels)
    data, display = window.pixels.shape[1::-1], (window.width, window.height)
    margins = overscan_margins(window.x, window.y, data, display) if overscan else NO_MARGINS
    width, height = margins.image_size(*display)
    check_size(path, width, height, max_pixels)
    position = window.x + margins.left, window.y + margins.top
    pixels = display_window(window.pixels, *position, width, height)
    header = window.attributes
    stated = Statements(header.get("chromaticities"), header.get("adoptedNeutral"))
    return SourceImage(pixels, digest_of(path), "", (), {}, margins=margins), stated


def _srgb_matrix(path: Path, stated: Statements) -> Array | None:
    """Return the 3x3 matrix to linear sRGB; None if it is not needed, or nothing is stated.

    Raises:
        ImageError: the colours that the file states are impossible.
    """
    if stated.chromaticities is None and stated.neutral is None:
        return None
    chromaticities = SRGB if stated.chromaticities is None else stated.chromaticities
    try:
        return to_linear_srgb(chromaticities, stated.neutral)
    except ImageError as error:
        raise ImageError(f"{path}: {error}") from None
