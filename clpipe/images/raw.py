"""Reading camera raws: CR2, NEF, ARW, DNG and the other formats of LibRaw, with a Bayer mosaic.

This is the only module that imports rawpy and exifread.
"""

import io
import logging
import math
import sys
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from clpipe.base.errors import ImageError
from clpipe.base.reading import check_regular, read_start
from clpipe.base.types import Array, Floats
from clpipe.camera.profile import SRGB_TO_XYZ, Matrix
from clpipe.images.dng import ARRAY_SEPARATOR, D65
from clpipe.images.encoding import SIMULATED
from clpipe.images.pixels import DEFAULT_MAX_PIXELS, MAX_PIXELS, check_size
from clpipe.images.tags import DATE
from clpipe.images.two_lights import TEMPERATURES, Light, camera_to_srgb
from clpipe.images.vocabularies import dng_warnings, raw_compression
from clpipe.reference.cfa import PATTERNS
from clpipe.reference.filter_array import MONO

RAW_SUFFIXES = (
    *(".3fr", ".arw", ".cr2", ".cr3", ".crw", ".dng", ".erf", ".fff", ".iiq", ".kdc", ".mef"),
    *(".mos", ".mrw", ".nef", ".nrw", ".orf", ".pef", ".raf", ".raw", ".rw2", ".rwl", ".sr2"),
    *(".srf", ".srw", ".x3f"),
)

MIN_BITS = 0.25  # bits per pixel; every compressed raw is assumed to have more
MAX_GAIN = 8.0  # largest white balance gain; the smallest is its inverse

# Converts LibRaw's flip to EXIF's orientation. The flip is a sum of 1 (mirror horizontally),
# 2 (mirror vertically) and 4 (then transpose).
ORIENTATIONS = {0: 1, 1: 2, 2: 4, 3: 3, 4: 5, 5: 8, 6: 6, 7: 7}

# The bytes before the EXIF in files that are not TIFF: in a CR3's boxes, in a RAF's JPEG.
EXIF_MARKS = (b"CMT1", b"CMT2", b"Exif\0\0")
MODEL = "Tag 0xC614"  # UniqueCameraModel of a DNG
TAG_PREFIXES = ("EXIF", "Image")  # exifread's prefixes of tags, in order of preference
EXIF_BYTES = 1 << 20  # largest size of a tag, and of the part of a file searched for EXIF_MARKS
MAX_READS = 200_000  # values; exifread reads each one separately, and 1,000 are usual
DATE_TAGS = ("DateTimeOriginal", "DateTime")
# Tags of a DNG: illuminant, color matrix and calibration of the camera, for two lights.
LIGHT_TAGS = ("0xC65A", "0xC621", "0xC623"), ("0xC65B", "0xC622", "0xC624")
ANALOG_BALANCE = "0xC627"
# Tags of a DNG's color matrices, and of their illuminants.
COLOR_MATRICES = {"0xC622": "0xC65B", "0xC621": "0xC65A"}
DUMP_HINT = "if it is a headerless dump of samples, add --dump WxH:TYPE"
OTHER_FORMATS = {b"\xff\xd8\xff": "a JPEG", b"\x89PNG": "a PNG", b"v/1\x01": "an OpenEXR image"}


@dataclass(frozen=True)
class RawInfo:
    """The metadata of a raw file. Levels are in DN, gains relative to green = 1; None is unknown.

    Implausible gains (outside 1/8 to 8) are None; ``as_shot`` contains the file's own values.
    """

    make: str
    model: str
    iso: float | None
    exposure: float | None  # s
    visible_area: tuple[int, int, int, int]  # left, top, width, height in sensor px
    pattern: str  # CFA of the visible area: a Bayer pattern, or rows separated by /
    # Black levels of the four sites of the pattern, row by row.
    black_levels: tuple[int, int, int, int]
    white_level: int
    as_shot: tuple[float, float, float]  # white balance multipliers of red, green, blue
    gains: tuple[float, float] | None  # red and blue, as shot
    xyz_to_camera: Matrix | None
    camera_to_srgb: Matrix | None  # matrix for linear, white-balanced RGB
    orientation: int  # EXIF's number: 1 is upright
    aperture: float | None
    focal_length: float | None  # mm
    taken: str  # "YYYY:MM:DD HH:MM:SS", or ""
    unused: tuple[str, ...] = ()  # sentences about what the file states, and clpipe does not use

    @property
    def black_level(self) -> int:
        """The common black level in DN, to which :func:`read_raw` shifts all four sites."""
        return round(sum(self.black_levels) / 4)


def read_raw_info(path: Path, max_pixels: int = DEFAULT_MAX_PIXELS) -> RawInfo:
    """Read the metadata of a raw file.

    Args:
        path: the file.
        max_pixels: a file with more pixels is rejected before it is read.

    Raises:
        ImageError: the file is missing, damaged, not a raw, too large, or not a mosaic.
    """
    exif = read_exif(path)
    with _open_raw(path, max_pixels) as raw:
        pattern = _pattern(path, raw, exif)
        speed, shutter, aperture, focal_length = _exposure_values(raw)
        iso = speed or exif.number("ISOSpeedRatings", 0)
        exposure = exif.number("ExposureTime", shutter)
        if not (exif.tags or iso or exposure):
            raise ImageError(f"{path}: this raw states no camera, ISO or exposure; {DUMP_HINT}")
        size = raw.sizes
        by_colour = raw.black_level_per_channel
        cell = np.resize(_colours(raw)[:2, :2], 4)
        first, second, third, fourth = (int(by_colour[c]) for c in cell)
        red, green, blue = map(float, raw.camera_whitebalance[:3])
        matrix = _matrix(raw.rgb_xyz_matrix[:3])
        # rawpy's color_matrix comes from the file, or from LibRaw if the file has none.
        to_srgb = _matrix(raw.color_matrix[:, :3])
        if to_srgb is None and matrix is not None:
            to_camera = np.array(matrix) @ SRGB_TO_XYZ
            to_srgb = _matrix(np.linalg.inv(to_camera / to_camera.sum(1, keepdims=True)))
        if (lights := exif.lights()) and min(red, green, blue) > 0:
            to_srgb = _matrix(camera_to_srgb(*lights, green / np.array([red, green, blue]))[0])
        return RawInfo(
            make=exif.text("Make") or "unknown",
            model=exif.text("Model").removeprefix(SIMULATED) or "unknown",
            iso=iso or None,
            exposure=exposure,
            visible_area=(size.left_margin, size.top_margin, size.width, size.height),
            pattern=pattern,
            black_levels=(first, second, third, fourth),
            white_level=int(raw.white_level),
            as_shot=(red, green, blue),
            gains=_gains(red, green, blue),
            xyz_to_camera=exif.color_matrix() if matrix is None else matrix,
            camera_to_srgb=to_srgb,
            orientation=ORIENTATIONS.get(size.flip, 1),
            aperture=exif.number("FNumber", aperture),
            focal_length=exif.number("FocalLength", focal_length),
            taken=next(filter(DATE.fullmatch, map(exif.text, DATE_TAGS)), ""),
            unused=tuple(dng_warnings(path)),
        )


def _gains(red: float, green: float, blue: float) -> tuple[float, float] | None:
    """Return white balance multipliers as gains of red and blue (green = 1); None if implausible.

    >>> _gains(1024.0, 512.0, 768.0), _gains(-2.0, 1.0, 1.5), _gains(2.0, 1.0, 100.0)
    ((2.0, 1.5), None, None)
    """
    if not (green > 0 and all(1 / MAX_GAIN <= c / green <= MAX_GAIN for c in (red, blue))):
        return None
    return red / green, blue / green


def _matrix(rows: Any) -> Matrix | None:
    """Return a 3x3 matrix, rounded to six digits; None if it is not finite, or singular."""
    values = np.asarray(rows, np.float64).round(6)
    if not np.isfinite(values).all() or abs(np.linalg.det(values)) < 1e-6:
        return None
    one, two, three = (tuple(row.tolist()) for row in values)
    return one, two, three


def read_raw(path: Path, info: RawInfo, max_pixels: int = DEFAULT_MAX_PIXELS) -> Floats:
    """Read the mosaic of the visible area in DN, (height, width).

    The sites of each colour are shifted to the common ``facts.black_level``.

    Raises:
        ImageError: as for :func:`read_raw_info`, or the file has no pixels.
    """
    with _open_raw(path, max_pixels) as raw:
        mosaic = np.array(raw.raw_image_visible, np.float32)
        blacks = np.array(raw.black_level_per_channel, np.float32)[_colours(raw)]
    # For a file whose pixels were removed, LibRaw returns whatever was in memory. A clean raw may
    # be uniform, but it is not below black, and its file contains a sample for each pixel.
    bits, darkest = path.stat().st_size * 8 / mosaic.size, mosaic.min()
    is_suspect = bits < 1 or darkest < info.black_level
    if bits < MIN_BITS or (is_suspect and darkest == mosaic.max()):
        raise ImageError(
            f"{path}: this raw has only metadata and no pixels; use the original file of the camera"
        )
    return mosaic + np.float32(info.black_level) - blacks


def check_raw(path: Path) -> None:
    """Check that LibRaw can read all of a raw, of any kind.

    Raises:
        ImageError: it cannot.
    """
    with _open_raw(path, sys.maxsize) as raw:
        raw.unpack()


def raw_size(path: Path) -> tuple[int, int]:
    """Return the width and height in px of the mosaic that a raw file claims.

    Raises:
        ImageError: the file is missing, damaged or not a raw.
    """
    with _open_raw(path, MAX_PIXELS) as raw:
        return raw.sizes.raw_width, raw.sizes.raw_height


@contextmanager
def _open_raw(path: Path, max_pixels: int) -> Iterator[Any]:
    """Open a file with rawpy.

    Raises:
        ImageError: it cannot be opened or decoded, or is too large.
    """
    import rawpy

    try:
        start = read_start(path, 8)
        if not start:
            raise ImageError(f"{path}: the file is empty")
        for mark, what in OTHER_FORMATS.items():
            if start.startswith(mark):
                raise ImageError(
                    f"{path}: this is {what}, not a camera raw. Give it the extension of its format"
                )
        with rawpy.imread(str(path)) as raw:
            check_size(path, raw.sizes.raw_width, raw.sizes.raw_height, max_pixels)
            yield raw
    except rawpy.LibRawError as error:
        reason = error.args[0].decode() if isinstance(error.args[0], bytes) else str(error)
        hint = f"; {DUMP_HINT}" if path.suffix.lower() == ".raw" else ""
        if compression := raw_compression(path):
            raise ImageError(
                f"{path}: its compression, {compression}, is not supported by LibRaw; convert it "
                "to a DNG with lossless compression"
            ) from None
        raise ImageError(
            f"{path}: the file is damaged, or LibRaw does not support it: {reason}{hint}"
        ) from None
    except OSError as error:
        raise ImageError(f"{path}: cannot be read: {error.strerror or error}") from None


def _exposure_values(raw: Any) -> tuple[float, float, float, float]:
    """Return ISO, exposure time (s), f-number and focal length (mm) from LibRaw; 0 is unknown."""
    try:
        other = raw.other
    except (ValueError, OverflowError, OSError):  # rawpy fails on an impossible date
        return 0.0, 0.0, 0.0, 0.0
    return other.iso_speed, other.shutter_speed, other.aperture, other.focal_length


def _colours(raw: Any) -> Array:
    """Return LibRaw's number of each pixel's colour in the visible area, (height, width)."""
    colours = np.asarray(raw.raw_colors_visible)
    return np.zeros_like(colours) if raw.num_colors == 1 else colours


def _pattern(path: Path, raw: Any, exif: "Exif") -> str:
    """Return the filter array of the visible area: a Bayer pattern, or rows of letters.

    Raises:
        ImageError: there is none, or it has colours besides red, green and blue.
    """
    if raw.raw_type.name != "Flat" or raw.raw_pattern is None:
        raise ImageError(
            f"{path}: this file has all colours at each pixel (a LinearRaw DNG of three colours), "
            "but clpipe develops mosaics. Develop it to a TIFF elsewhere and use -c unprocess"
        )
    if raw.num_colors == 1:
        return MONO
    array = exif.text(MODEL).partition(ARRAY_SEPARATOR)[2]  # LibRaw may misread this array
    if {*array} - {*"RGB/"}:
        raise ImageError(
            f"{path}: its filter array is {array}. clpipe only reads DNG files whose array has "
            "red, green and blue. Keep the mosaic as EXR (--keep mosaic) to read it again"
        )
    if array:
        return array
    height, width = raw.raw_pattern.shape
    letters = raw.color_desc.decode()
    rows = ["".join(letters[c] for c in row[:width]) for row in _colours(raw)[:height]]
    if "".join(rows) in PATTERNS:
        return "".join(rows)
    if {*"".join(rows)} == {*"RGB"} and (height, width) != (2, 2):
        return "/".join(rows)
    raise ImageError(
        f"{path}: its pattern is {'/'.join(rows)}. clpipe develops {', '.join(PATTERNS)}, larger "
        "patterns of red, green and blue, and sensors without colours"
    )


@dataclass(frozen=True)
class Exif:
    """The EXIF tags of a file, by exifread's names."""

    tags: dict[str, Any]

    def text(self, name: str) -> str:
        """Return the text of a tag in the first part that has it; "" if none has."""
        texts = (str(self.tags.get(f"{part} {name}", "")).strip("\0 ") for part in TAG_PREFIXES)
        return next((text for text in texts if text), "")

    def number(self, name: str, default: float) -> float | None:
        """Return a tag's first number, or ``default``; None unless it is finite and above 0."""
        value = default
        for part in TAG_PREFIXES:
            if tag := self.tags.get(f"{part} {name}"):
                try:
                    value = float(tag.values[0])
                except (AttributeError, IndexError, TypeError, ValueError, ZeroDivisionError):
                    value = 0
                break
        return value if 0 < value < math.inf else None

    def color_matrix(self) -> Matrix | None:
        """Return the ColorMatrix of a DNG for D65, from CIE XYZ; None if there is none."""
        for name, illuminant in COLOR_MATRICES.items():
            if self.number(f"Tag {illuminant}", 0) == D65 and f"Image Tag {name}" in self.tags:
                with suppress(TypeError, ValueError, ZeroDivisionError):
                    values = [float(value) for value in self.tags[f"Image Tag {name}"].values]
                    return _matrix(np.reshape(values, (3, 3)))
        return None

    def lights(self) -> tuple[Light, Light] | None:
        """Return a DNG's matrices for two lights; None unless it states both."""
        found = []
        for illuminant, matrix, calibration in LIGHT_TAGS:
            temperature = TEMPERATURES.get(int(self.number(f"Tag {illuminant}", 0) or 0))
            colours = self._numbers(matrix, 9)
            if temperature is None or colours is None:
                return None
            own, balance = self._numbers(calibration, 9), self._numbers(ANALOG_BALANCE, 3)
            camera = np.reshape(colours, (3, 3))
            camera = camera if own is None else np.reshape(own, (3, 3)) @ camera
            camera = camera if balance is None else np.diag(balance) @ camera
            if _matrix(camera) is None:
                return None
            found.append(Light(float(temperature), camera))
        one, two = found
        return (one, two) if one.temperature != two.temperature else None

    def _numbers(self, name: str, count: int) -> list[float] | None:
        """Return the numbers of a tag; None unless it has this many."""
        with suppress(AttributeError, KeyError, TypeError, ValueError, ZeroDivisionError):
            values = [float(value) for value in self.tags[f"Image Tag {name}"].values]
            return values if len(values) == count else None
        return None


def read_exif(path: Path) -> Exif:
    """Return the EXIF of a file, which may be empty.

    Raises:
        ImageError: the file cannot be read.
    """
    try:
        check_regular(path)
        with path.open("rb") as file:
            tags = _tags(file)
            if not tags:
                file.seek(0)
                head = file.read(EXIF_BYTES)
                for mark in (m for m in EXIF_MARKS if m in head):
                    tags |= _tags(io.BytesIO(head[head.index(mark) + len(mark) :]))
    except FileNotFoundError:
        raise ImageError(f"{path}: no such file") from None
    except OSError as error:
        raise ImageError(f"{path}: cannot be read: {error.strerror or error}") from None
    return Exif(tags)


class _LimitedReader:
    """Wraps a file, and stops reading if its tags claim more values than are plausible."""

    def __init__(self, file: Any) -> None:
        self._file = file
        self._count = 0

    def read(self, size: int = EXIF_BYTES) -> bytes:
        self._count += 1
        if self._count > MAX_READS:
            raise ValueError
        return self._file.read(min(size, EXIF_BYTES))

    def __getattr__(self, name: str) -> Any:
        return getattr(self._file, name)


def _tags(file: Any) -> dict[str, Any]:
    """Return the EXIF tags of an open file; {} if it is damaged, which LibRaw reports better."""
    import exifread

    logging.getLogger("exifread").setLevel(logging.CRITICAL)
    try:
        return dict(exifread.process_file(_LimitedReader(file), details=False))
    except Exception:  # exifread raises exceptions of any type for damaged files
        return {}
