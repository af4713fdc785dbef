"""Reading images: renders and kept images as linear light, mosaics, finished pictures."""

from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import OpenImageIO as oiio

from clpipe.base.cpu_time import CpuTimer
from clpipe.base.digests import stamp_of
from clpipe.base.errors import ImageError
from clpipe.base.files import sha256_of
from clpipe.base.types import Array, Doubles
from clpipe.images.attributes import own_attributes, photograph_attributes, shot_attributes
from clpipe.images.colour import CIE_XYZ, SRGB, to_linear_srgb
from clpipe.images.layers import (
    MOST_PARTS,
    PictureLocation,
    find_picture,
    mosaic_channel,
    picture_channels,
)
from clpipe.images.luminance_chroma import read_luminance_chroma
from clpipe.images.openexr import read_channels
from clpipe.images.openimageio import SubsampledError, error_text, open_image
from clpipe.images.pixels import (
    HALF_MAX,
    USUAL_MAX_PIXELS,
    by_rows,
    check_size,
    clip_to_half,
    display_window,
    make_finite,
    margins_of,
)
from clpipe.reference.defocus import Depth
from clpipe.reference.geometry import NO_MARGINS, Margins
from clpipe.reference.panorama import Panorama
from clpipe.reference.transfer import inverse_srgb_curve
from clpipe.stage import Kind

RENDER_SUFFIXES = (".exr", ".hdr", ".pfm", ".tif", ".tiff")
PICTURE_SUFFIXES = (".jpg", ".jpeg", ".png", ".tif", ".tiff", ".exr")
LARGE_FILE = 4 << 20  # bytes; to start a thread takes as long as the SHA-256 of a small one
READ_AT_ONCE = 8  # channels; those of a picture may lie hundreds apart


@dataclass(frozen=True)
class SourceImage:
    """An image as it came from a file.

    ``pixels`` is (height, width, 3) linear RGB or a (height, width) mosaic, float16 or float32,
    finite. It is C-contiguous, or planar: a transposed view of a C-contiguous (3, height, width)
    array. ``layer`` is the name of the layer that was read. ``attributes`` are clpipe's own, which
    a kept image has, and a photograph's tags. ``shot`` is what the file says of exposure_time (s),
    focal_length and sensor_width (mm). ``subframes`` are the names and SHA-256 of files that were
    averaged, and ``later`` what further exposures see than that of ``pixels``, which are alike.
    ``depth`` is there where the chain needs it. ``margins`` say how far ``pixels``, and depth, go
    on beyond the picture. ``envmap`` is OpenImageIO's name of the map that the file says it is, and
    ``panorama`` what an atlas of several views is one of.
    """

    pixels: Array
    sha256: str
    layer: str
    warnings: tuple[str, ...]
    attributes: Mapping[str, str]
    shot: Mapping[str, float] = field(default_factory=dict)
    subframes: tuple[tuple[str, str], ...] = ()
    later: tuple[Array, ...] = ()
    depth: Depth | None = None
    margins: Margins = NO_MARGINS
    envmap: str = ""
    panorama: Panorama | None = None


@dataclass(frozen=True)
class _Decoded:
    """The samples of a picture, (height, width[, channel]), and what the header says of them."""

    pixels: Array
    sha256: str
    layer: str
    attributes: Mapping[str, str]
    shot: Mapping[str, float]
    chromaticities: Any  # as the file states them; None: linear sRGB's
    neutral: Any  # OpenEXR's adoptedNeutral, as the file states it
    margins: Margins
    envmap: str = ""


def read_image(
    path: Path,
    mosaic: bool = False,
    layer: str | None = None,
    max_pixels: int = USUAL_MAX_PIXELS,
    overscan: bool = False,
) -> SourceImage:
    """Read the picture of a file as linear sRGB, in its display window, with finite samples.

    The picture is R, G and B by name, else X, Y and Z, else luminance, which becomes grey. Other
    primaries than sRGB's are converted. Half samples stay half unless they are converted. Alpha,
    depth and other layers are not read. NaN and infinity become 0, with a warning. Pixels of the
    display window outside the data window are black.

    Args:
        path: the file.
        mosaic: read a single channel instead, which may also hold whole numbers of 16 or 32 bits.
        layer: the layer or part that is the picture; None chooses, see
            :data:`clpipe.images.layers.PICTURE_LAYERS`.
        max_pixels: a file that claims more is refused before memory is allocated.
        overscan: read what the data window has beyond the display window, too, as margins.

    Raises:
        ImageError: the file is missing, empty, damaged, not an image, not linear float, deep, a
            texture or too large, or it lacks the channels or the layer; the message
            names the file and the reason.
    """
    try:
        decoded = _decode(path, mosaic, layer, max_pixels, overscan)
    except SubsampledError:
        if mosaic or layer is not None:
            raise
        decoded = _decode_luminance_chroma(path, max_pixels, overscan)
    warnings = []
    pixels = decoded.pixels
    if count := make_finite(pixels):
        warnings.append(f"{count} samples were NaN or infinite and were set to 0")
    if pixels.ndim == 2 and not mosaic:
        pixels = np.stack([pixels] * 3, axis=-1)
        warnings.append("it holds luminance alone; the picture is grey")
    elif not mosaic:
        matrix = _srgb_matrix(path, decoded)
        if matrix is not None:
            with np.errstate(all="ignore"):  # overflow is clipped below
                pixels = by_rows(
                    lambda rows: np.nan_to_num(rows.astype(np.float32) @ matrix.T, copy=False),
                    pixels,
                )
            warnings.append("its colours were converted to linear sRGB")
    # Beyond half it is so bright that nothing is lost, and no stage's squares overflow.
    if not mosaic and pixels.dtype == np.float32 and (beyond := clip_to_half(pixels)):
        warnings.append(f"{beyond} samples beyond {HALF_MAX:g}, the range of half, were clipped")
    return SourceImage(
        pixels,
        decoded.sha256,
        decoded.layer,
        tuple(warnings),
        decoded.attributes,
        decoded.shot,
        margins=decoded.margins,
        envmap=decoded.envmap,
    )


TRANSFERS: dict[str, Callable[[Doubles], Doubles]] = {
    "linear": lambda x: x,
    "srgb": inverse_srgb_curve,
}


@dataclass(frozen=True)
class ReadOptions:
    """How files are read.

    ``layer``, ``max_pixels`` and, for linear RGB, ``overscan`` are those of :func:`read_image`.
    ``transfer``, one of :data:`TRANSFERS`, is how renders in whole numbers (PNG, TIFF) are encoded;
    None refuses them.
    """

    layer: str | None = None
    max_pixels: int = USUAL_MAX_PIXELS
    transfer: str | None = None
    overscan: bool = False


def read_source(path: Path, kind: Kind, options: ReadOptions) -> SourceImage:
    """Read a file as the kind of image that a chain starts on.

    Raises:
        ImageError: the file cannot be read, or holds another kind.
    """
    if (
        kind is Kind.RGB
        and options.transfer
        and (finished := read_finished(path, options.max_pixels))
    ):
        curve = TRANSFERS[options.transfer]
        linear = by_rows(lambda rows: curve(rows.astype(np.float64)), finished.pixels)
        return replace(finished, pixels=linear)
    if kind is not Kind.DISPLAY:
        mosaic = len(kind.channels) == 1
        overscan = options.overscan and kind is Kind.RGB
        return read_image(path, mosaic, options.layer, options.max_pixels, overscan)
    if finished := read_finished(path, options.max_pixels):
        return finished
    image = read_image(path, False, options.layer, options.max_pixels)
    if image.attributes.get("kind") != kind.label:
        raise ImageError(
            f"{path}: holds linear light, but the chain starts on finished pictures "
            "(JPEG, PNG or TIFF, 8 or 16 bits)"
        )
    return image


def read_finished(path: Path, max_pixels: int = USUAL_MAX_PIXELS) -> SourceImage | None:
    """Read a finished picture (JPEG, PNG, TIFF): display values, (height, width, 3), 0..1.

    None where the file does not hold red, green and blue in whole numbers of 8 or 16 bits; then it
    is one for :func:`read_image`. Alpha is not read. ``max_pixels`` is that of :func:`read_image`.

    Raises:
        ImageError: the file is missing, empty, damaged, not an image or too large.
    """
    with open_image(path) as file:
        spec = file.spec()
        picture = picture_channels(list(spec.channelnames))
        if picture is None or spec.format.basetype not in (oiio.UINT8, oiio.UINT16):
            return None
        check_size(path, spec.width, spec.height, max_pixels)
        rgb = read_samples(path, file, 0, picture[1], oiio.FLOAT)  # scales whole numbers to 0..1
        attributes, shot = photograph_attributes(spec)
        return SourceImage(np.ascontiguousarray(rgb), _digest(path), "", (), attributes, shot)


def read_whole_numbers(path: Path, max_pixels: int = USUAL_MAX_PIXELS) -> Array:
    """The first channel of a picture, (height, width), uint8 or uint16, as the file has it.

    Raises:
        ImageError: the file cannot be read, holds other samples, or is too large.
    """
    with open_image(path) as file:
        spec = file.spec()
        if spec.format.basetype not in (oiio.UINT8, oiio.UINT16):
            raise ImageError(
                f"{path}: holds {spec.format} samples; expected whole numbers of 8 or 16 bits"
            )
        check_size(path, spec.width, spec.height, max_pixels)
        return read_samples(path, file, 0, (0,), spec.format.basetype)[..., 0]


def photograph_facts(path: Path) -> tuple[float | None, int]:
    """The ISO in the EXIF of a finished picture, None where it does not say it, and its bits.

    Raises:
        ImageError: the file is missing, empty, damaged or not an image.
    """
    with open_image(path) as file:
        iso = file.spec().getattribute("Exif:PhotographicSensitivity")
        bits = 8 * file.spec().format.size()
    return float(iso) if isinstance(iso, int) and iso > 0 else None, bits


def holds_mosaic(path: Path) -> bool:
    """Whether a file has no red, green and blue, but one channel that may be a mosaic.

    Raises:
        ImageError: the file is missing, empty, damaged or not an image.
    """
    with open_image(path) as file:
        parts: list[list[str]] = []
        while len(parts) < MOST_PARTS and file.seek_subimage(len(parts), 0):
            parts.append(list(file.spec().channelnames))
    return not any(map(picture_channels, parts)) and any(map(mosaic_channel, parts))


@CpuTimer("decode")
def _decode(
    path: Path, mosaic: bool, layer: str | None, max_pixels: int, overscan: bool
) -> _Decoded:
    """The picture of a file that OpenImageIO reads; arguments and errors as :func:`read_image`.

    Raises:
        SubsampledError: the channels differ in size.
    """
    with open_image(path) as file:
        location = find_picture(path, file, mosaic, layer)
        spec = file.spec()
        data, display = (spec.width, spec.height), (spec.full_width, spec.full_height)
        x, y = spec.x - spec.full_x, spec.y - spec.full_y
        margins = margins_of(x, y, data, display) if overscan else NO_MARGINS
        pixels, digest = _with_digest(
            path, lambda: _read_part(path, file, location, mosaic, max_pixels, margins)
        )
        return _Decoded(
            pixels,
            digest,
            location.layer,
            own_attributes(spec),
            shot_attributes(spec),
            CIE_XYZ if location.xyz else spec.getattribute("chromaticities"),
            spec.getattribute("adoptedNeutral"),
            margins,
            str(spec.getattribute("textureformat") or ""),
        )


@CpuTimer("decode")
def _decode_luminance_chroma(path: Path, max_pixels: int, overscan: bool) -> _Decoded:
    """The picture of a file whose chroma is subsampled."""
    window = read_luminance_chroma(path, max_pixels)
    data, display = window.pixels.shape[1::-1], (window.width, window.height)
    margins = margins_of(window.x, window.y, data, display) if overscan else NO_MARGINS
    width, height = margins.around(*display)
    check_size(path, width, height, max_pixels)
    place = window.x + margins.left, window.y + margins.top
    pixels = display_window(window.pixels, *place, width, height)
    header = window.attributes
    chromaticities, neutral = header.get("chromaticities"), header.get("adoptedNeutral")
    return _Decoded(pixels, _digest(path), "", {}, {}, chromaticities, neutral, margins)


def _with_digest(path: Path, read: Callable[[], Array]) -> tuple[Array, str]:
    """What is read of a file, and the file's SHA-256, computed meanwhile if it takes long.

    Raises:
        ImageError: one of them cannot be had.
    """
    if stamp_of(path)[0] < LARGE_FILE:
        return read(), _digest(path)
    with ThreadPoolExecutor(1) as beside:
        digest = beside.submit(_digest, path)
        return read(), digest.result()


def _digest(path: Path) -> str:
    """The SHA-256 of a file.

    Raises:
        ImageError: it cannot be read any more.
    """
    try:
        return sha256_of(path)[0]
    except OSError as error:
        raise ImageError(f"{path}: cannot be read: {error.strerror}") from None


def _srgb_matrix(path: Path, decoded: _Decoded) -> Array | None:
    """The 3x3 matrix to linear sRGB; None where the file is in linear sRGB or does not say.

    Raises:
        ImageError: the colours that the file states are impossible.
    """
    if decoded.chromaticities is None and decoded.neutral is None:
        return None
    chromaticities = SRGB if decoded.chromaticities is None else decoded.chromaticities
    try:
        return to_linear_srgb(chromaticities, decoded.neutral)
    except ImageError as error:
        raise ImageError(f"{path}: {error}") from None


def _read_part(
    path: Path,
    file: Any,
    location: PictureLocation,
    mosaic: bool,
    max_pixels: int,
    margins: Margins,
) -> Array:
    """Three channels of one part, or one, in its display window with margins: (height, width[, 3]).

    Raises:
        ImageError: the samples are not linear float (those of a mosaic may be whole numbers), too
            many, or damaged.
    """
    spec, channels = file.spec(), location.channels
    formats = spec.channelformats or [spec.format] * spec.nchannels
    types = {formats[i].basetype for i in channels}
    whole = mosaic and types <= {oiio.UINT16, oiio.UINT32}
    if not whole and not types <= {oiio.HALF, oiio.FLOAT, oiio.DOUBLE}:
        raise ImageError(
            f"{path}: holds {spec.format} samples, not linear float ones; "
            "give an OpenEXR file, or say --transfer linear or srgb; a photograph: -c unprocess"
        )
    width, height = margins.around(spec.full_width, spec.full_height)
    check_size(path, width, height, max_pixels)
    check_size(path, spec.width, spec.height, max_pixels)
    # Whole numbers are read as they are: as float, OpenImageIO would scale them to 0..1.
    type_ = types.pop() if whole else oiio.HALF if types == {oiio.HALF} else oiio.FLOAT
    pixels = None
    if file.format_name() == "openexr" and not whole:
        names = [spec.channelnames[i] for i in channels]
        pixels = read_channels(path, names, (spec.height, spec.width))
    if pixels is None:
        pixels = read_samples(path, file, location.part, channels, type_)
    if whole:
        pixels = pixels.astype(np.float32)
    place = spec.x - spec.full_x + margins.left, spec.y - spec.full_y + margins.top
    if (*place, spec.width, spec.height) != (0, 0, width, height):
        pixels = display_window(pixels, *place, width, height)
    return pixels if len(channels) > 1 else np.ascontiguousarray(pixels[..., 0])


def read_samples(path: Path, file: Any, part: int, channels: Sequence[int], type_: Any) -> Array:
    """Channels of a part's data window, (rows, columns, channel), as samples of a type.

    Raises:
        ImageError: the part is damaged, or a volume.
    """
    spec = file.spec()
    if spec.depth > 1:
        raise ImageError(f"{path}: a volume of {spec.depth} images, not a picture")
    first, last = min(channels), max(channels) + 1
    if last - first > READ_AT_ONCE:
        planes = [read_samples(path, file, part, [i], type_) for i in channels]
        return np.concatenate(planes, axis=-1)
    data = file.read_image(part, 0, first, last, type_)
    problem = file.geterror()
    if data is None or problem:
        raise ImageError(f"{path}: damaged: {error_text(problem)}")
    pixels = np.asarray(data).reshape(spec.height, spec.width, last - first)
    order = [i - first for i in channels]
    return pixels if order == list(range(last - first)) else pixels[..., order]
