"""Reading camera raws: CR2, NEF, ARW, DNG and the other formats of LibRaw, with a Bayer mosaic.

This is the only module that imports rawpy.
"""

import io
import math
import sys
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from clpipe.base.errors import ImageError
from clpipe.base.reading import read_start
from clpipe.base.types import Array, Doubles, Floats
from clpipe.camera.profile import SRGB_TO_XYZ, Matrix
from clpipe.images.dng import ARRAY_SEPARATOR, D65
from clpipe.images.encoding import SIMULATED
from clpipe.images.pixels import DEFAULT_MAX_PIXELS, MAX_PIXELS, check_size
from clpipe.images.tags import DATE_PATTERN, FLIPS
from clpipe.images.tiff import read_directories
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
ORIENTATIONS = {int(np.dot(flips, (1, 2, 4))): number for number, flips in FLIPS.items()}

# The bytes before the EXIF in files that are not TIFF: in a CR3's boxes, in a RAF's JPEG.
EXIF_MARKS = (b"CMT1", b"CMT2", b"Exif\0\0")
EXIF_BYTES = 1 << 20  # size of the part of a file that is searched for EXIF_MARKS
EXIF_VERSION = 36864  # only the EXIF directory has this tag
MAKE, MODEL, UNIQUE_MODEL = 271, 272, 50708
EXPOSURE_TIME, F_NUMBER, ISO, FOCAL_LENGTH = 33434, 33437, 34855, 37386
DATES = (36867, 306)  # DateTimeOriginal, DateTime
# Tags of a DNG: illuminant, color matrix and calibration of the camera, for two lights.
LIGHT_TAGS = (50778, 50721, 50723), (50779, 50722, 50724)
ANALOG_BALANCE = 50727
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
        iso = speed or exif.number(ISO, 0)
        exposure = exif.number(EXPOSURE_TIME, shutter)
        if not (exif.directories or iso or exposure):
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
            make=exif.text(MAKE) or "unknown",
            model=exif.text(MODEL).removeprefix(SIMULATED) or "unknown",
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
            aperture=exif.number(F_NUMBER, aperture),
            focal_length=exif.number(FOCAL_LENGTH, focal_length),
            taken=next(filter(DATE_PATTERN.fullmatch, map(exif.text, DATES)), ""),
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
    array = exif.text(UNIQUE_MODEL).partition(ARRAY_SEPARATOR)[2]  # LibRaw may misread this array
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
    """The tags of a file: the values of each directory by tag, the EXIF directory first."""

    directories: Sequence[Mapping[int, tuple[Any, ...]]]

    def values(self, tag: int) -> tuple[Any, ...]:
        """Return the values of a tag in the first directory that has it; () if none has."""
        return next((each[tag] for each in self.directories if tag in each), ())

    def text(self, tag: int) -> str:
        """Return the text of a tag; "" if there is none."""
        return str(*self.values(tag)[:1]).strip()

    def number(self, tag: int, default: float) -> float | None:
        """Return a tag's first number, or ``default``; None unless it is finite and above 0."""
        value = next(iter(self.values(tag)), default)
        is_number = isinstance(value, int | float) and 0 < value < math.inf
        return float(value) if is_number else None

    def numbers(self, tag: int, *shape: int) -> Doubles | None:
        """Return the numbers of a tag as an array of a shape; None unless it has this many."""
        with suppress(ValueError):
            return np.array(self.values(tag), np.float64).reshape(shape)
        return None

    def color_matrix(self) -> Matrix | None:
        """Return the ColorMatrix of a DNG for D65, from CIE XYZ; None if there is none."""
        for illuminant, matrix, _ in reversed(LIGHT_TAGS):
            colours = self.numbers(matrix, 3, 3)
            if self.number(illuminant, 0) == D65 and colours is not None:
                return _matrix(colours)
        return None

    def lights(self) -> tuple[Light, Light] | None:
        """Return a DNG's matrices for two lights; None unless it states both."""
        found = []
        for illuminant, matrix, calibration in LIGHT_TAGS:
            temperature = TEMPERATURES.get(int(self.number(illuminant, 0) or 0))
            camera = self.numbers(matrix, 3, 3)
            if temperature is None or camera is None:
                return None
            own, balance = self.numbers(calibration, 3, 3), self.numbers(ANALOG_BALANCE, 3)
            camera = camera if own is None else own @ camera
            camera = camera if balance is None else np.diag(balance) @ camera
            if _matrix(camera) is None:
                return None
            found.append(Light(float(temperature), camera))
        one, two = found
        return (one, two) if one.temperature != two.temperature else None


def read_exif(path: Path) -> Exif:
    """Return the EXIF of a file, which may be empty.

    Raises:
        ImageError: the file cannot be read.
    """
    try:
        head = read_start(path, EXIF_BYTES)
    except FileNotFoundError:
        raise ImageError(f"{path}: no such file") from None
    except OSError as error:
        raise ImageError(f"{path}: cannot be read: {error.strerror or error}") from None
    directories = [*read_directories(path)] or [
        directory
        for mark in EXIF_MARKS
        if mark in head
        for directory in read_directories(io.BytesIO(head.partition(mark)[2]))
    ]
    return Exif(sorted(directories, key=lambda each: EXIF_VERSION not in each))
