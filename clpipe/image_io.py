"""Image files in and out. The only importer of OpenImageIO and Pillow."""

import contextlib
import hashlib
import json
import os
import secrets
import shutil
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import OpenImageIO as oiio
from numpy.typing import NDArray
from PIL import Image, ImageCms
from pydantic import TypeAdapter

import clpipe
from clpipe.camera import Positive
from clpipe.errors import ImageError, KindError
from clpipe.exr_colour import CIE_XYZ, SRGB, to_linear_srgb
from clpipe.luminance_chroma import read_luminance_chroma
from clpipe.output import Output, exif
from clpipe.printable import printable
from clpipe.stage import Kind
from clpipe.stages.inverse_gamma import inverse_srgb_curve
from clpipe.types import Array, Floats

READABLE = (".exr", ".hdr", ".pfm", ".tif", ".tiff")
FINISHED = (".jpg", ".jpeg", ".png", ".tif", ".tiff", ".exr")
JPEG_MAX_SIDE = 65500
HALF_MAX = np.float32(65504)  # so bright that nothing is lost, and no square overflows
# Else the time of writing is put in, and no two runs make the same bytes.
NO_TIME = "1970:01:01 00:00:00"
ATTRIBUTES = "clpipe:"  # what the names of our own begin with
MAX_PIXELS = 1_000_000_000  # what a device is ever given
USUAL_MAX_PIXELS = 200_000_000  # what a file may claim, where nobody says otherwise
# Layers that hold the finished picture, in order of preference: no layer, then common names.
PICTURE_LAYERS = ("", "combined", "beauty", "rgba", "rgb", "color", "default")


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
class Reading:
    """How files are read, where that is not left to them.

    ``layer`` and ``max_pixels`` are those of :func:`read_image`. ``transfer`` is that of renders in
    whole numbers (PNG, TIFF), one of :data:`TRANSFERS`; None refuses them.
    """

    layer: str | None = None
    max_pixels: int = USUAL_MAX_PIXELS
    transfer: str | None = None


def read_source(path: Path, kind: Kind, how: Reading) -> SourceImage:
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


def sha256_of(path: Path) -> tuple[str, int]:
    """The SHA-256 of a file, and its size in bytes.

    Raises:
        OSError: it cannot be read.
    """
    digest = hashlib.sha256()
    with open(path, "rb", buffering=0) as file:
        while part := file.read(4 << 20):
            digest.update(part)
        return digest.hexdigest(), file.tell()


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


@dataclass(frozen=True)
class _Picture:
    """Where in a file the picture is: the part, the layer as it is called, the channels."""

    part: int
    layer: str
    channels: tuple[int, ...]
    xyz: bool = False

    @property
    def rank(self) -> tuple[bool, int, int, str]:
        """Pictures in order of preference: colour, then a known name, then as in the file."""
        known = self.layer.lower().rpartition(".")[2]
        names = [*PICTURE_LAYERS, known]
        return len(self.channels) < 3, names.index(known), self.part, self.layer


def _find_picture(path: Path, file: Any, mosaic: bool, layer: str | None) -> _Picture:
    """The picture of a file, which is then at its part.

    Raises:
        ImageError: there is none, or it is of a kind that cannot be read.
    """
    found: list[str] = []
    pictures: list[_Picture] = []
    refusals: list[str] = []
    several = file.seek_subimage(1, 0)
    part = 0
    while file.seek_subimage(part, 0):
        spec = file.spec()
        part += 1
        if refusal := _no_picture(spec, file.seek_subimage(part - 1, 1)):
            refusals.append(refusal)
            continue
        names = list(spec.channelnames)
        found += [name for name in names if name not in found]
        kept = "kind" in _attributes(spec)
        called = str(spec.getattribute("oiio:subimagename") or "") if several else ""
        if mosaic:
            channel = mosaic_channel(names)
            here = [_Picture(part - 1, *channel)] if channel else []
        else:
            here = [
                _Picture(part - 1, _joined(called, own), channels, xyz)
                for own, channels, xyz in _layers(names, kept)
            ]
        if kept and not here:
            raise KindError(path, _attributes(spec))
        pictures += here
    if layer is not None and pictures:
        named = [p for p in pictures if p.layer.lower() == layer.lower()]
        if not named:
            listed = ", ".join(dict.fromkeys(p.layer or "one without a name" for p in pictures))
            raise ImageError(
                f"{path}: no layer {layer!r} with a picture; its layers: {printable(listed)}"
            )
        pictures = named
    if not pictures and refusals:
        raise ImageError(f"{path}: {refusals[0]}")
    if not pictures:
        listed = ", ".join(name for name in found[:20] if name) or "none"
        wanted = "no single channel with a mosaic" if mosaic else "no R, G and B channels"
        raise ImageError(f"{path}: {wanted}; found {printable(listed)}")
    best = min(pictures, key=lambda picture: picture.rank)
    file.seek_subimage(best.part, 0)
    file.geterror()  # of parts and levels that were looked for and are not there
    return best


def _no_picture(spec: Any, has_levels: bool) -> str:
    """Why a part is no picture, whatever its channels; "" where it may be one."""
    if spec.deep:
        return "a deep image (many samples a pixel); flatten it in the renderer first"
    if "CubeFace" in str(spec.getattribute("textureformat")):
        return "a cube map, not a picture"
    return "a texture (one image in several sizes), not a picture" if has_levels else ""


def _joined(part: str, layer: str) -> str:
    """A layer's name with its part's, unless it begins with that.

    >>> _joined("left", ""), _joined("left", "beauty"), _joined("View", "View.Combined")
    ('left', 'left.beauty', 'View.Combined')
    """
    if f"{layer}.".startswith(f"{part}."):
        return layer
    return f"{part}.{layer}" if part and layer else part or layer


def _layers(names: Sequence[str], kept: bool) -> Iterator[tuple[str, tuple[int, ...], bool]]:
    """The layers that can be a picture: their names, channels, and whether those are X, Y and Z.

    Only a layer without a name is a picture in X, Y and Z; others are positions and normals. Only
    one that has nothing beside it is luminance, and none that clpipe kept is.
    """
    for layer in dict.fromkeys(name.rpartition(".")[0] for name in names):
        place = {
            name.rpartition(".")[2].lower(): i
            for i, name in enumerate(names)
            if name.rpartition(".")[0].lower() == layer.lower()
        }
        here = set(place)
        if here >= set("rgb"):
            wanted = "rgb"
        elif not kept and not layer and here - {"a"} == set("xyz"):
            wanted = "xyz"
        elif not kept and here - {"a", "z"} == {"y"}:
            wanted = "y"
        else:
            continue
        yield layer, tuple(place[c] for c in wanted), wanted == "xyz"


def _attributes(spec: Any) -> dict[str, str]:
    """clpipe's own attributes of a part."""
    return {
        a.name.removeprefix(ATTRIBUTES): str(a.value)
        for a in spec.extra_attribs
        if a.name.startswith(ATTRIBUTES)
    }


def shot_of(spec: Any) -> dict[str, float]:
    """What OpenEXR's standard attributes say of a shot, as far as it can be true."""
    size = spec.getattribute("sensorOverallDimensions")
    said = {
        "exposure_time": spec.getattribute("ExposureTime"),
        "focal_length": spec.getattribute("effectiveFocalLength")
        or spec.getattribute("nominalFocalLength"),
        "sensor_width": max(size) if isinstance(size, tuple) else None,
    }
    return {k: v for k, v in said.items() if isinstance(v, float) and 0 < v <= 10_000}


def read_attributes(path: Path) -> dict[str, str]:
    """The attributes that clpipe gave to a kept image; none if the file is no such image."""
    file = oiio.ImageInput.open(str(path)) if path.is_file() else None
    with contextlib.suppress(UnicodeDecodeError):
        if file is None:
            oiio.geterror()  # it would be told at the next call
            return {}
        with contextlib.closing(file):
            return _attributes(file.spec())
    return {}


def mosaic_channel(names: Sequence[str]) -> tuple[str, tuple[int]] | None:
    """The only channel that is neither alpha nor depth.

    >>> mosaic_channel(["Raw"]), mosaic_channel(["A", "Y"]), mosaic_channel(["X", "Y"])
    (('', (0,)), ('', (1,)), None)
    """
    places = [i for i, name in enumerate(names) if len(names) == 1 or name not in ("A", "Z")]
    return ("", (places[0],)) if len(places) == 1 else None


def picture_channels(names: Sequence[str]) -> tuple[str, tuple[int, ...]] | None:
    """The layer that holds the picture, and where its R, G and B stand among the channels.

    >>> picture_channels(["View.Depth.Z", "View.Combined.B", "View.Combined.G", "View.Combined.R"])
    ('View.Combined', (3, 2, 1))
    """
    pictures = [_Picture(0, *layer) for layer in _layers(names, kept=True)]
    best = min(pictures, key=lambda picture: picture.rank, default=None)
    return (best.layer, best.channels) if best else None


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


@cache
def srgb_profile() -> bytes:
    """An ICC profile of sRGB, always the same bytes."""
    profile = bytearray(ImageCms.ImageCmsProfile(ImageCms.createProfile("sRGB")).tobytes())
    profile[24:36] = bytes(12)  # the date of creation
    return bytes(profile)


_unfinished: set[Path] = set()


def write_beside(path: Path, write: Callable[[Path], object]) -> None:
    """Write a file under a temporary name beside ``path``, then rename it: never half a file.

    Raises:
        ImageError: the file cannot be written.
    """
    beside = path.with_name(f".{path.stem}.{secrets.token_hex(4)}.part{path.suffix}")
    _unfinished.add(beside)
    try:
        write(beside)
        beside.replace(path)
    except OSError as error:
        raise ImageError(f"{path}: cannot be written: {error.strerror or error}") from None
    finally:
        with contextlib.suppress(OSError):
            beside.unlink(missing_ok=True)
        _unfinished.discard(beside)


def write_new(path: Path, write: Callable[[Path], object]) -> None:
    """The same, where the folders above it may have to be made.

    Raises:
        ImageError: the file cannot be written.
    """
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise ImageError(f"{path}: cannot be written: {error.strerror}") from None
    write_beside(path, write)


def drop_unfinished() -> None:
    """Remove the halves of files that are being written now, before the process is ended."""
    for path in list(_unfinished):
        with contextlib.suppress(OSError):
            path.unlink(missing_ok=True)


@dataclass(frozen=True)
class Tags:
    """What goes into a picture's EXIF, and how it is encoded; None is not known."""

    make: str
    model: str
    iso: Positive
    exposure: Positive | None = None  # s
    aperture: Positive | None = None
    focal_length: Positive | None = None  # mm
    taken: str = ""  # "YYYY:MM:DD HH:MM:SS"
    output: Output = field(default_factory=Output)

    @property
    def shot(self) -> dict[str, float]:
        """What is known of the shot, by the names of :class:`clpipe.output.Output`."""
        found = {"exposure_time": self.exposure, "focal_length": self.focal_length}
        return {name: value for name, value in found.items() if value}


CARRIED = ("exif", "orientation")  # attributes that go with an image from stage to stage


def carry(tags: Tags, orientation: int) -> dict[str, str]:
    """The attributes by which an image carries its tags and its orientation (as EXIF has it)."""
    own = {name: value for name, value in asdict(tags).items() if name != "output"}
    return {"exif": json.dumps(own), "orientation": str(orientation)}


def carried(attributes: Mapping[str, str], otherwise: Tags) -> tuple[Tags, int]:
    """The tags and the orientation that an image carries; where none, others, and upright.

    Raises:
        ImageError: they are damaged.
    """
    try:
        text = attributes.get("exif")
        tags = TypeAdapter(Tags).validate_json(text) if text else otherwise
        orientation = int(attributes.get("orientation", 1))
        if orientation not in FLIPS:
            raise ValueError
    except ValueError:
        raise ImageError("its attributes clpipe:exif and clpipe:orientation are damaged") from None
    return tags, orientation


# By EXIF's orientation: whether to flip left to right, upside down, and then to transpose.
FLIPS = {
    1: (False, False, False),
    2: (True, False, False),
    3: (True, True, False),
    4: (False, True, False),
    5: (False, False, True),
    6: (False, True, True),
    7: (True, True, True),
    8: (True, False, True),
}


def upright(image: Array, orientation: int) -> Array:
    """An image, (height, width[, channel]), turned as EXIF's orientation says.

    >>> upright(np.array([[1, 2], [3, 4]]), 6).tolist()  # its right side is now at the bottom
    [[3, 1], [4, 2]]
    """
    mirrored, upside_down, transposed = FLIPS[orientation]
    image = image[:, ::-1] if mirrored else image
    image = image[::-1] if upside_down else image
    return np.ascontiguousarray(image.swapaxes(0, 1) if transposed else image)


def write_display(path: Path, pixels: Array, tags: Tags) -> None:
    """Write a picture, (height, width[, 3]), as JPEG, PNG or TIFF, with EXIF.

    Whole numbers of 8 or 16 bits get an sRGB profile; float samples (TIFF) do not. JPEG is encoded
    as ``tags.output`` says. A TIFF's EXIF is without the ISO, for which OpenImageIO has no way.

    Raises:
        ImageError: the file cannot be written.
    """
    height, width = pixels.shape[:2]
    channels = pixels.shape[2] if pixels.ndim == 3 else 1
    samples = "float" if pixels.dtype.kind == "f" else pixels.dtype.name
    spec = oiio.ImageSpec(width, height, channels, samples)
    output = tags.output
    jpeg = path.suffix == ".jpg"
    spec.attribute("compression", f"jpeg:{output.jpeg_quality}" if jpeg else "zip")
    if jpeg:
        spec.attribute("jpeg:subsampling", output.jpeg_subsampling)
        spec.attribute("jpeg:progressive", int(output.jpeg_progressive))
    if channels == 3 and pixels.dtype.kind == "u":
        icc = np.frombuffer(srgb_profile(), np.uint8)
        spec.attribute("ICCProfile", oiio.TypeDesc(f"uint8[{len(icc)}]"), icc)
        spec.attribute("Exif:ColorSpace", 1)  # sRGB
    spec.attribute("Make", tags.make)
    spec.attribute("Model", tags.model)
    spec.attribute("Software", f"clpipe {clpipe.__version__}")
    for name, value in exif(tags.iso, output, max(height, width)).items():
        if name == "ExposureTime":
            # OpenImageIO cuts off after the sixth digit, and 0.01 is 0.0099999998 in float.
            above = float(np.nextafter(np.float32(value), np.float32(np.inf)))
            spec.attribute(name, above)
        else:
            spec.attribute(f"Exif:{name}", value)
    if tags.aperture:
        spec.attribute("FNumber", tags.aperture)
    if tags.taken:
        spec.attribute("Exif:DateTimeOriginal", tags.taken)
    if tags.taken or path.suffix == ".tif":
        spec.attribute("DateTime", tags.taken or NO_TIME)
    _write(path, spec, pixels.reshape(height, width, channels))


def write_exr(
    path: Path,
    pixels: Floats,
    channels: Sequence[str],
    attributes: Mapping[str, str],
    half: bool = False,
) -> None:
    """Write a float image, (height, width[, channel]), as OpenEXR (ZIP), channels named.

    The names of ``attributes`` get clpipe's prefix in the file. Half holds 11 bits and at most
    65504; what is beyond is clipped.

    Raises:
        ImageError: the file cannot be written.
    """
    height, width = pixels.shape[:2]
    spec = oiio.ImageSpec(width, height, len(channels), oiio.HALF if half else oiio.FLOAT)
    spec.channelnames = tuple(channels)
    spec.attribute("compression", "zip")
    spec.attribute("DateTime", NO_TIME)
    for name, value in attributes.items():
        spec.attribute(ATTRIBUTES + name, value)
    data = np.clip(pixels, -HALF_MAX, HALF_MAX) if half else pixels
    _write(path, spec, data.reshape(height, width, len(channels)))


def _write(path: Path, spec: Any, pixels: Array) -> None:
    """Write (height, width, channel) as OpenImageIO does, which does not hold the GIL.

    Raises:
        ImageError: the file cannot be written.
    """

    def write(to: Path) -> None:
        if to.suffix != ".jpg":
            _encode(str(to), str(to), spec, pixels)
            return
        # libjpeg ends the process when it cannot write, so it writes to memory.
        memory = os.memfd_create("jpeg")
        with open(memory, "rb", buffering=0) as encoded:
            _encode("jpeg", f"/proc/self/fd/{memory}", spec, pixels)
            with open(to, "wb", buffering=0) as file:
                shutil.copyfileobj(encoded, file, 8 << 20)

    write_beside(path, write)


def _encode(format_: str, to: str, spec: Any, pixels: Array) -> None:
    """Write pixels in a format, which may be that of a file's name.

    Raises:
        OSError: they cannot be written.
    """
    file = oiio.ImageOutput.create(format_)
    data = np.ascontiguousarray(pixels)
    if file is None or not file.open(to, spec) or not file.write_image(data):
        raise OSError(0, _reason(file.geterror() if file else oiio.geterror()))
    if not file.close():
        raise OSError(0, _reason(file.geterror()))


def versions() -> dict[str, str]:
    """The versions of what reads and writes files."""
    return {"OpenImageIO": oiio.__version__, "Pillow": Image.__version__}  # type: ignore[attr-defined]
