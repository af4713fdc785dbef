"""Lenses by name, from lensfun's database, as parameters of stages."""

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from difflib import get_close_matches
from functools import cache, lru_cache
from math import hypot
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

from clpipe.base.errors import KeyedError, RequestError
from clpipe.base.extras import install_command
from clpipe.base.text import one_line
from clpipe.camera.profile import Camera

INSTALL = install_command("lensfunpy")
INFINITY_DISTANCE = 1000.0  # m; the distance used for lensfun's calibrations at infinity
MAX_EXTRA_WORDS = 2  # words of a lens's name, in addition to the maker, that you may omit
RECTILINEAR = "RECTILINEAR"  # lensfun's type of the lenses that clpipe supports
SAME_CROP = 1.01  # crop factors with at most this ratio count as equal
ASPECT = 1.5  # assumed aspect ratio of the calibration images if the database lacks it


@dataclass(frozen=True)
class LensCalibration:
    """lensfun's calibration of a lens at one setting.

    Args:
        name: name of the lens, with its maker.
        focal_length: in mm.
        distortion, vignetting: the method of the stage and its parameters; empty if lensfun has no
            data.
        crop_factor: of the image's sensor: the diagonal of 35 mm film over its own.
        is_of_smaller_sensor: whether it was calibrated on a smaller sensor than the camera's.
    """

    name: str
    focal_length: float
    distortion: Mapping[str, Any]
    vignetting: Mapping[str, Any]
    crop_factor: float = 1.0
    is_of_smaller_sensor: bool = False


def calibration_of(
    name: str,
    camera: Camera,
    focal_length: float | None = None,
    aperture: float | None = None,
    focus_distance: float | None = None,
) -> LensCalibration:
    """Return the calibration of a lens, as parameters of the stages distortion and vignetting.

    Args:
        name: the model, or a part of it that belongs to no other model.
        camera: if lensfun knows it, the image has its sensor's size. Else the sensor is that of the
            camera on which the lens was calibrated.
        focal_length: in mm; None for a prime lens.
        aperture: the f-number; without it there is no vignetting.
        focus_distance: in m; None is far away.

    Raises:
        RequestError: lensfunpy is not installed, there is no such lens, or it cannot be set to
            these values.
    """
    # A camera cannot be a key of a cache, so its names are passed.
    models = camera.make, camera.model, *camera.aliases
    return _calibration(name, models, focal_length, aperture, focus_distance)


@lru_cache(maxsize=256)
def _calibration(
    name: str,
    models: tuple[str, ...],
    focal_length: float | None,
    aperture: float | None,
    focus_distance: float | None,
) -> LensCalibration:
    database = _database()
    crop = _crop_factor(database, *models)
    lens = _find_lens(database, name, crop)
    focal = _focal_length(lens, focal_length)
    ratio = lens.crop_factor / (crop or lens.crop_factor)
    vignetting: dict[str, Any] = {}
    if distortion := _distortion(lens, focal):
        # lensfun's r = 1 is half the short side of the image that the lens was calibrated with.
        distortion |= {"unit": 1 / (hypot(1, _aspect(lens)) * ratio)}
    if aperture is not None:
        _check_aperture(lens, aperture)
        correction = lens.interpolate_vignetting(
            focal, aperture, focus_distance or INFINITY_DISTANCE
        )
        if correction and correction.model.name == "PA":
            terms = (term * ratio ** (2 * i) for i, term in enumerate(correction.terms, 1))
            vignetting = {"method": "pa"} | dict(zip(("k1", "k2", "k3"), terms, strict=True))
    is_smaller = crop is not None and lens.crop_factor > crop * SAME_CROP
    image_crop = crop or lens.crop_factor
    return LensCalibration(_name(lens), focal, distortion, vignetting, image_crop, is_smaller)


def name_note(name: str) -> str:
    """Return a warning if a lens is named by a part of its name, else "".

    Raises:
        KeyedError: lensfunpy is not installed, or there is no such lens, or several.
    """
    lens = _find_lens(_database(), name, None)
    if not _extra_words(lens, _words(name)):
        return ""
    return (
        f"warning: lens: '{one_line(name)}' is a part of a name, and clpipe uses {_name(lens)}; "
        "to be sure of the lens, use its full name"
    )


def lens_names() -> list[str]:
    """Return all lenses of lensfun's database that :func:`calibration_of` accepts, in their order.

    Raises:
        KeyedError: lensfunpy is not installed.
    """
    lenses = _database().lenses
    return sorted({_name(lens) for lens in lenses if lens.type.name == RECTILINEAR})


def _distortion(lens: Any, focal: float) -> dict[str, Any]:
    """Return the method of ``distortion`` and its coefficients; empty if lensfun has no data."""
    correction = lens.interpolate_distortion(focal)
    lateral = lens.interpolate_tca(focal)
    names = {"POLY3": ("k1",), "POLY5": ("k1", "k2"), "PTLENS": ("a", "b", "c")}
    table: dict[str, Any] = {}
    if correction and correction.model.name in names:
        table = {"method": correction.model.name.lower()}
        table |= dict(zip(names[correction.model.name], correction.terms, strict=False))
    colours = {"LINEAR": ("kr", "kb"), "POLY3": ("vr", "vb", "cr", "cb", "br", "bb")}
    if lateral and lateral.model.name in colours:
        coefficients = dict(zip(colours[lateral.model.name], lateral.terms, strict=False))
        table = {"method": "poly3", **table, **coefficients}
    return table


def _database() -> Any:
    try:
        return _load_database()
    except ImportError:
        raise KeyedError(
            "lens",
            "lens: lensfun's database needs lensfunpy, which is in the extra 'lens'. Run: "
            + INSTALL,
        ) from None


@cache
def _load_database() -> Any:
    import lensfunpy

    return lensfunpy.Database()


def _words(text: str) -> list[str]:
    """Return the words of a lens's name, regardless of separators, without mm and f.

    >>> _words("EF 24-70mm f/2.8L"), _words("ef24-70 F2.8 l")
    (['ef', '24', '70', '2.8', 'l'], ['ef', '24', '70', '2.8', 'l'])
    """
    words = re.findall(r"[a-z]+|\d+(?:\.\d+)?", text.lower())
    return [word for word in words if word not in ("mm", "f")]


def _name(lens: Any) -> str:
    """Return maker and model, without repeating the maker."""
    has_maker = lens.model.lower().startswith(lens.maker.lower())
    return lens.model if has_maker else f"{lens.maker} {lens.model}"


def _find_lens(database: Any, name: str, crop: float | None) -> Any:
    """Return the lens with this name, or the one with all its words and the fewest others.

    It may have at most :data:`MAX_EXTRA_WORDS` other words.

    If a lens has several calibrations, the one on the largest sensor that is not larger than the
    camera's is used, like in lensfun.

    Raises:
        KeyedError: there is no such lens, or several.
    """
    words_wanted = _words(name)
    matches = [
        (len(words) - len(words_wanted), lens)
        for lens in database.lenses
        if not _lacks_word(words_wanted, words := _words(_name(lens)))
    ]
    if not words_wanted or not matches:
        names = sorted({_name(lens) for lens in database.lenses})
        by_lower = {each.lower(): each for each in names}
        similar = [by_lower[each] for each in get_close_matches(name.lower(), by_lower, 3, 0.3)]
        nearest = (
            f"the nearest are {', '.join(similar)}"
            if similar
            else "use a name with its maker and model"
        )
        raise KeyedError("lens", f"lens: lensfun has no lens '{one_line(name)}'; {nearest}")
    fewest = min(count for count, _ in matches)
    best = [lens for count, lens in matches if count == fewest]
    models = sorted({_name(lens) for lens in best})
    if len(models) > 1 or _extra_words(best[0], words_wanted) > MAX_EXTRA_WORDS:
        models = sorted({_name(lens) for _, lens in matches})
        others = f", or {len(models) - 5} more" if len(models) > 5 else ""
        listed = " or ".join(models[:5])
        raise KeyedError(
            "lens",
            f"lens: '{one_line(name)}' may mean {listed}{others}; use the full name of one",
        )
    smaller = [lens for lens in best if crop and lens.crop_factor <= crop * SAME_CROP]
    return max(smaller or best, key=lambda lens: lens.crop_factor if smaller else -lens.crop_factor)


def _extra_words(lens: Any, requested: Sequence[str]) -> int:
    """Return how many words of a lens's name, besides the maker, were not requested."""
    maker = set(_words(lens.maker)) - set(requested)
    return len(_words(_name(lens))) - len(requested) - len(maker)


def _lacks_word(requested: Sequence[str], words: Sequence[str]) -> bool:
    """Return whether a word is requested more often than it occurs."""
    return any(words.count(word) < requested.count(word) for word in requested)


def _crop_factor(database: Any, make: str, *models: str) -> float | None:
    """Return the crop factor of a camera, None if lensfun does not know it."""
    for model in models:
        for found in database.find_cameras(make, model):
            return float(found.crop_factor)
    return None


def _focal_length(lens: Any, focal: float | None) -> float:
    """Return a focal length of the lens, in mm.

    Raises:
        RequestError: the lens does not have this focal length, or it has several and none is set,
            or it is a fisheye.
    """
    name, low, high = _name(lens), lens.min_focal, lens.max_focal or lens.min_focal
    if lens.type.name != RECTILINEAR:
        raise KeyedError(
            "lens",
            f"lens: {name} is not rectilinear, and lensfun describes it relative to another "
            "projection than a render's; set distortion.method=fisheye and its k1 to k4",
        )
    if focal is None:
        if low != high:
            raise RequestError(f"focal_length: {name} is a zoom; set {low:g} to {high:g} mm")
        return float(low)
    if not low - 0.05 <= focal <= high + 0.05:
        raise KeyedError(
            "focal_length",
            f"focal_length: {focal:g} mm is not possible, because {name} has {low:g}"
            + (f" to {high:g} mm" if low != high else " mm only"),
        )
    return focal


def _check_aperture(lens: Any, aperture: float) -> None:
    """Check that a lens can be set to an f-number, if lensfun knows its range.

    Raises:
        KeyedError: it cannot.
    """
    # lensfun returns None for an unknown value.
    low, high = lens.min_aperture or 0.0, lens.max_aperture or 0.0
    if (low and aperture < low - 0.06) or (high > low and aperture > high + 0.06):
        most = f" to f/{high:g}" if high > low else " and above"
        raise KeyedError(
            "aperture",
            f"aperture: f/{aperture:g} is not possible, because {_name(lens)} has f/{low:g}{most}",
        )


def _aspect(lens: Any) -> float:
    """Return the aspect ratio, long over short side, of the images a lens was calibrated with."""
    return _aspects().get((lens.maker, lens.model, round(lens.crop_factor, 3)), ASPECT)


@cache
def _aspects() -> dict[tuple[str, str, float], float]:
    """Return the aspect ratios in the database, by maker, model and crop factor.

    lensfunpy does not provide them, so they are read from its files.
    """
    import lensfunpy

    aspects = {}
    for path in Path(lensfunpy.__file__).parent.glob("db_files/*.xml"):
        for lens in ElementTree.parse(path).iter("lens"):  # noqa: S314 - the file is part of lensfunpy
            if text := lens.findtext("aspect-ratio"):
                width, _, height = text.partition(":")
                key = lens.findtext("maker", ""), lens.findtext("model", "")
                crop = round(float(lens.findtext("cropfactor", "1")), 3)
                aspects[(*key, crop)] = float(width) / float(height or 1)
    return aspects
