"""Camera raw files in: CR2, NEF, ARW, DNG and what else LibRaw reads.

The only importer of rawpy and exifread.
"""

import io
import logging
import math
import re
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from clpipe.base.errors import ImageError
from clpipe.base.types import Floats
from clpipe.camera.profile import SRGB_TO_XYZ, Matrix
from clpipe.images.encoding import SIMULATED
from clpipe.reference.cfa import PATTERNS, Pattern

RAW_SUFFIXES = (
    *(".3fr", ".arw", ".cr2", ".cr3", ".crw", ".dng", ".erf", ".fff", ".iiq", ".kdc", ".mef"),
    *(".mos", ".mrw", ".nef", ".nrw", ".orf", ".pef", ".raf", ".raw", ".rw2", ".rwl", ".sr2"),
    *(".srf", ".srw", ".x3f"),
)

LEAST_BITS = 0.25  # a pixel, in any compressed raw
MOST_GAIN = 20.0  # of white balance; what is above is damaged or a joke

# LibRaw's flip (1: left to right, 2: upside down, 4: then transposed) as EXIF's orientation.
ORIENTATIONS = {0: 1, 1: 2, 2: 4, 3: 3, 4: 5, 5: 8, 6: 6, 7: 7}

# Where the EXIF of files begins that are no TIFF: in a CR3's boxes, in a RAF's JPEG.
EXIF_MARKS = (b"CMT1", b"CMT2", b"Exif\0\0")
PARTS = ("EXIF", "Image")  # of EXIF, where exifread finds tags
DATE_TAGS = ("DateTimeOriginal", "DateTime")
DATE = re.compile(r"\d{4}:\d\d:\d\d \d\d:\d\d:\d\d")
OTHERS = {b"\xff\xd8\xff": "a JPEG", b"\x89PNG": "a PNG", b"v/1\x01": "an OpenEXR image"}


@dataclass(frozen=True)
class RawFacts:
    """What a raw file says of itself. Levels in DN, gains with green = 1; None is not said.

    Gains that cannot be (not above 0, or above 20) are None; ``as_shot`` has what the file says.
    """

    make: str
    model: str
    iso: float | None
    exposure: float | None  # s
    visible_area: tuple[int, int, int, int]  # of the sensor: left, top, width, height; px
    pattern: Pattern  # of the visible area
    black_levels: tuple[int, int, int, int]  # of the pattern's four sites, row by row
    white_level: int
    as_shot: tuple[float, float, float]  # white balance multipliers of red, green, blue
    gains: tuple[float, float] | None  # red, blue, as shot
    daylight_gains: tuple[float, float] | None  # red, blue
    xyz_to_camera: Matrix | None
    camera_to_srgb: Matrix | None  # of white-balanced RGB, linear
    orientation: int  # as EXIF has it: 1 is upright
    aperture: float | None
    focal_length: float | None  # mm
    taken: str  # "YYYY:MM:DD HH:MM:SS", or ""

    @property
    def black_level(self) -> int:
        """The black level that :func:`read_raw` brings all channels to."""
        return round(sum(self.black_levels) / 4)


def read_facts(path: Path) -> RawFacts:
    """What a raw file says of itself, without its pixels being decoded.

    Raises:
        ImageError: it is missing, damaged, no raw, or holds no Bayer mosaic; the message says why.
    """
    said = _exif(path)
    with _opened(path) as raw:
        pattern = _pattern(path, raw)
        speed, shutter, aperture, focal_length = _shot(raw)
        iso = speed or said.number("ISOSpeedRatings", 0)
        exposure = said.number("ExposureTime", shutter)
        if not (said.tags or iso or exposure):
            raise ImageError(
                f"{path}: names no camera, ISO or exposure; a dump of samples, not a camera's raw "
                "(clpipe run takes it with --raw-size and --raw-type)"
            )
        size = raw.sizes
        by_colour = raw.black_level_per_channel
        cell = raw.raw_colors_visible[:2, :2].ravel()
        first, second, third, fourth = (int(by_colour[c]) for c in cell)
        red, green, blue = map(float, raw.camera_whitebalance[:3])
        matrix = _matrix(raw.rgb_xyz_matrix[:3])
        # cmatrix is the file's own, where there is one, and LibRaw's else.
        to_srgb = _matrix(raw.color_matrix[:, :3])
        if to_srgb is None and matrix is not None:
            to_camera = np.array(matrix) @ SRGB_TO_XYZ
            to_srgb = _matrix(np.linalg.inv(to_camera / to_camera.sum(1, keepdims=True)))
        return RawFacts(
            make=said.text("Make") or "unknown",
            model=said.text("Model").removeprefix(SIMULATED) or "unknown",
            iso=iso or None,
            exposure=exposure,
            visible_area=(size.left_margin, size.top_margin, size.width, size.height),
            pattern=pattern,
            black_levels=(first, second, third, fourth),
            white_level=int(raw.white_level),
            as_shot=(red, green, blue),
            gains=_gains(red, green, blue),
            daylight_gains=_gains(*raw.daylight_whitebalance[:3]) if to_srgb else None,
            xyz_to_camera=matrix,
            camera_to_srgb=to_srgb,
            orientation=ORIENTATIONS.get(size.flip, 1),
            aperture=said.number("FNumber", aperture),
            focal_length=said.number("FocalLength", focal_length),
            taken=next(filter(DATE.fullmatch, map(said.text, DATE_TAGS)), ""),
        )


def _gains(red: float, green: float, blue: float) -> tuple[float, float] | None:
    """White balance multipliers as gains of red and blue; None if they cannot be.

    >>> _gains(1024.0, 512.0, 768.0), _gains(-2.0, 1.0, 1.5), _gains(2.0, 1.0, 100.0)
    ((2.0, 1.5), None, None)
    """
    if green <= 0 or not all(0 < c / green <= MOST_GAIN for c in (red, blue)):
        return None
    return red / green, blue / green


def _matrix(rows: Any) -> Matrix | None:
    """Three rows of three; None where they are no matrix that can be inverted."""
    values = np.asarray(rows, np.float64).round(6)
    if not np.isfinite(values).all() or abs(np.linalg.det(values)) < 1e-6:
        return None
    one, two, three = (tuple(row.tolist()) for row in values)
    return one, two, three


def read_raw(path: Path, facts: RawFacts) -> Floats:
    """The mosaic of the visible area in DN, (height, width), every channel's black level brought to
    ``facts.black_level``.

    Raises:
        ImageError: as :func:`read_facts`; or there are no pixels in it.
    """
    with _opened(path) as raw:
        _pattern(path, raw)
        mosaic = np.array(raw.raw_image_visible, np.float32)
    # LibRaw gives whatever was in memory for a file whose pixels were taken out.
    if path.stat().st_size * 8 < LEAST_BITS * mosaic.size or mosaic.min() == mosaic.max():
        raise ImageError(f"{path}: there are no pixels in it, only what describes them")
    for site, black in enumerate(facts.black_levels):
        mosaic[site // 2 :: 2, site % 2 :: 2] += np.float32(facts.black_level - black)
    return mosaic


@contextmanager
def _opened(path: Path) -> Iterator[Any]:
    """The file as rawpy opens it.

    Raises:
        ImageError: it cannot be opened or decoded.
    """
    import rawpy

    try:
        with path.open("rb") as file:
            start = file.read(8)
        if not start:
            raise ImageError(f"{path}: the file is empty")
        for mark, what in OTHERS.items():
            if start.startswith(mark):
                raise ImageError(f"{path}: it is {what}, not a camera's raw, whatever its name")
        with rawpy.imread(str(path)) as raw:
            yield raw
    except rawpy.LibRawError as error:
        reason = error.args[0].decode() if isinstance(error.args[0], bytes) else str(error)
        raise ImageError(f"{path}: damaged, or no raw that LibRaw knows: {reason}") from None
    except OSError as error:
        raise ImageError(f"{path}: cannot be read: {error.strerror or error}") from None


def _shot(raw: Any) -> tuple[float, float, float, float]:
    """ISO, exposure (s), aperture and focal length (mm) as LibRaw has them; 0 is not known."""
    try:
        other = raw.other
    except (ValueError, OverflowError, OSError):  # of a date that cannot be
        return 0.0, 0.0, 0.0, 0.0
    return other.iso_speed, other.shutter_speed, other.aperture, other.focal_length


def _pattern(path: Path, raw: Any) -> Pattern:
    """The Bayer pattern of the visible area.

    Raises:
        ImageError: there is none.
    """
    if raw.raw_type.name != "Flat" or raw.raw_pattern is None:
        raise ImageError(
            f"{path}: holds every colour at every pixel (a LinearRaw DNG, or a sensor without a "
            "colour filter array); a Bayer mosaic is needed"
        )
    if raw.raw_pattern.shape != (2, 2):
        height, width = raw.raw_pattern.shape
        raise ImageError(
            f"{path}: its colours repeat every {width}x{height} pixels (X-Trans, or another); "
            "a Bayer mosaic is needed"
        )
    letters = raw.color_desc.decode()
    found = "".join(letters[c] for c in raw.raw_colors_visible[:2, :2].ravel())
    for pattern in PATTERNS:
        if pattern == found:
            return pattern
    raise ImageError(f"{path}: its pattern is {found}; one of {', '.join(PATTERNS)} is needed")


@dataclass(frozen=True)
class _Exif:
    """A file's EXIF, by the names that exifread gives."""

    tags: dict[str, Any]

    def text(self, name: str) -> str:
        """What a tag says, in the main part or in EXIF's own; "" if it is not there."""
        both = (str(self.tags.get(f"{part} {name}", "")).strip("\0 ") for part in PARTS)
        return next((text for text in both if text), "")

    def number(self, name: str, otherwise: float) -> float | None:
        """A tag's first number, or what holds where there is no such tag; None if not above 0."""
        found = otherwise
        for part in PARTS:
            if tag := self.tags.get(f"{part} {name}"):
                try:
                    found = float(tag.values[0])
                except (AttributeError, IndexError, TypeError, ValueError, ZeroDivisionError):
                    found = 0
                break
        return found if 0 < found < math.inf else None


def _exif(path: Path) -> _Exif:
    """A file's EXIF, as far as it has one.

    Raises:
        ImageError: the file cannot be read.
    """
    try:
        with path.open("rb") as file:
            tags = _tags(file)
            if not tags:
                file.seek(0)
                head = file.read(1 << 20)
                for mark in (m for m in EXIF_MARKS if m in head):
                    tags |= _tags(io.BytesIO(head[head.index(mark) + len(mark) :]))
    except FileNotFoundError:
        raise ImageError(f"{path}: no such file") from None
    except OSError as error:
        raise ImageError(f"{path}: cannot be read: {error.strerror or error}") from None
    return _Exif(tags)


def _tags(file: Any) -> dict[str, Any]:
    """The tags of an open file; none where it is damaged, of which LibRaw says more."""
    import exifread

    logging.getLogger("exifread").setLevel(logging.CRITICAL)
    try:
        return dict(exifread.process_file(file, details=False))
    except Exception:  # of any kind, on damaged files
        return {}
