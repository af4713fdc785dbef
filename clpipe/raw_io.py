"""Camera raw files in: CR2, NEF, ARW, DNG and what else LibRaw reads.

The only importer of rawpy and exifread.
"""

import logging
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from clpipe.camera import Matrix
from clpipe.errors import ImageError
from clpipe.reference.cfa import PATTERNS, Pattern
from clpipe.types import Floats

ENDINGS = (
    *(".3fr", ".arw", ".cr2", ".cr3", ".crw", ".dng", ".erf", ".fff", ".iiq", ".kdc", ".mef"),
    *(".mos", ".mrw", ".nef", ".nrw", ".orf", ".pef", ".raf", ".raw", ".rw2", ".rwl", ".sr2"),
    *(".srf", ".srw", ".x3f"),
)
LEAST_BITS = 0.25  # a pixel, in any compressed raw


@dataclass(frozen=True)
class RawFacts:
    """What a raw file says of itself. Levels in DN, gains with green = 1; None is not said."""

    make: str
    model: str
    iso: float | None
    exposure: float | None  # s
    pattern: Pattern  # of the visible area
    black_levels: tuple[int, int, int, int]  # of the pattern's four sites, row by row
    white_level: int
    gains: tuple[float, float] | None  # red, blue, as shot
    xyz_to_camera: Matrix | None

    @property
    def black_level(self) -> int:
        """The black level that :func:`read_raw` brings all channels to."""
        return round(sum(self.black_levels) / 4)


def read_facts(path: Path) -> RawFacts:
    """What a raw file says of itself, without its pixels being decoded.

    Raises:
        ImageError: it is missing, damaged, no raw, or holds no Bayer mosaic; the message says why.
    """
    make, model, iso, exposure = _exif(path)
    with _opened(path) as raw:
        pattern = _pattern(path, raw)
        iso = raw.other.iso_speed or iso
        exposure = raw.other.shutter_speed or exposure
        if not (make or model or iso or exposure):
            raise ImageError(
                f"{path}: names no camera, ISO or exposure; a dump of samples, not a camera's raw "
                "(make it a 16-bit TIFF or PNG, and give --pattern, --black-level, --white-level)"
            )
        by_colour = raw.black_level_per_channel
        cell = raw.raw_colors_visible[:2, :2].ravel()
        first, second, third, fourth = (int(by_colour[c]) for c in cell)
        red, green, blue, _ = raw.camera_whitebalance
        gains = (red / green, blue / green) if min(red, green, blue) > 0 else None
        red_row, green_row, blue_row = np.asarray(raw.rgb_xyz_matrix, np.float64)[:3].round(6)
        matrix: Matrix = (
            tuple(red_row.tolist()),
            tuple(green_row.tolist()),
            tuple(blue_row.tolist()),
        )
        known = abs(np.linalg.det(matrix)) > 1e-6
        return RawFacts(
            make=make or "unknown",
            model=model or "unknown",
            iso=iso or None,
            exposure=exposure or None,
            pattern=pattern,
            black_levels=(first, second, third, fourth),
            white_level=int(raw.white_level),
            gains=gains,
            xyz_to_camera=matrix if known else None,
        )


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

    if not path.is_file():
        raise ImageError(f"{path}: no such file")
    try:
        with rawpy.imread(str(path)) as raw:
            yield raw
    except rawpy.LibRawError as error:
        reason = error.args[0].decode() if isinstance(error.args[0], bytes) else str(error)
        raise ImageError(f"{path}: damaged, or no raw that LibRaw knows: {reason}") from None
    except OSError as error:
        raise ImageError(f"{path}: cannot be read: {error.strerror or error}") from None


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


def _exif(path: Path) -> tuple[str, str, float | None, float | None]:
    """Make, model, ISO and exposure time from a file's EXIF, as far as it has one."""
    import exifread

    logging.getLogger("exifread").setLevel(logging.CRITICAL)
    try:
        with path.open("rb") as file:
            tags = exifread.process_file(file, details=False)
    except OSError as error:
        raise ImageError(f"{path}: cannot be read: {error.strerror or error}") from None
    except Exception:  # of any kind, on damaged files; LibRaw says what is wrong with them
        tags = {}

    def number(name: str) -> float | None:
        values = getattr(tags.get(name), "values", None) or [0]
        try:
            return float(values[0]) or None
        except (TypeError, ValueError, ZeroDivisionError):
            return None

    make, model = (str(tags.get(f"Image {name}", "")).strip() for name in ("Make", "Model"))
    return make, model, number("EXIF ISOSpeedRatings"), number("EXIF ExposureTime")
