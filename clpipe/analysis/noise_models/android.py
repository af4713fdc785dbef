"""Reads Android's DNG noise model, which CameraITS (tests/dng_noise_model) generates for devices.

Its functions are compute_noise_model_entry_S and _O: a = A*ISO + B, and b = C*ISO^2 + D*gain^2. The
digital gain is max(1, ISO / the highest analogue ISO). Planes are in the order R, Gr, Gb, B.
"""

import math
import re
from pathlib import Path

from clpipe.analysis.noise_models.model import TEN_BITS, Law, SensorModel
from clpipe.base.errors import RequestError

MARK = "noise_model_A"

# Lengths are bounded, so that matching takes time in proportion to the length of the text.
_SPACE = r"\s{0,9}"
_COEFFICIENTS = rf'"?{_SPACE}(?:\[{_SPACE}\])?{_SPACE}[=:]{_SPACE}[\[{{]([^\]}}]{{1,999}})[\]}}]'
_NUMBER = r"([0-9.]{1,30}(?:[eE][+-]?[0-9]{1,4})?)"
_HIGHEST_ANALOGUE = re.compile(rf"\bsens{_SPACE}/{_SPACE}{_NUMBER}")
_RANGE = re.compile(
    rf"\bsens{_SPACE}={_SPACE}([0-9]{{1,9}});{_SPACE}sens{_SPACE}<={_SPACE}([0-9]{{1,9}});"
)


def parse_android(text: str, path: Path) -> SensorModel:
    """Return the noise of a phone from the text of its noise model, at full stops of ISO.

    Args:
        text: C, or another language with the same names and numbers. It is not executed.
        path: the file, for messages and for the name of the camera, which the text lacks.

    Raises:
        RequestError: coefficients are missing, or do not describe noise.
    """
    factors = {key: _green(text, key, path) for key in "ABCD"}
    found = _HIGHEST_ANALOGUE.search(text)
    highest = _number(found[1]) if found else math.inf
    if not highest > 0:
        raise RequestError(
            f"{path}: its highest analogue ISO is {found and found[1]}, but this ISO must "
            "be above 0"
        )
    isos, range_source = _isos(text, highest)
    laws = []
    for iso in isos:
        gain = max(1.0, iso / highest)
        a = factors["A"] * iso + factors["B"]
        b = factors["C"] * iso**2 + factors["D"] * gain**2
        if a > 0 and b > 0:
            laws.append(Law(iso, a, b))
    if not laws:
        raise RequestError(
            f"{path}: a and b are not both above 0 at any ISO from {isos[0]:g} to {isos[-1]:g}, so "
            "its coefficients do not describe a camera's noise"
        )
    law = " ".join(f"{key} = {value:.6g}" for key, value in factors.items())
    digital = f"beyond ISO {highest:g} by digital gain" if found else "digital gain not stated"
    source = (
        f"Android DNG noise model {path.name}, green: a = A ISO + B, b = C ISO^2 + D gain^2, "
        f"{law}, {digital}{range_source}"
    )
    return SensorModel("unknown", path.stem, laws, source, TEN_BITS)


def _green(text: str, key: str, path: Path) -> float:
    """Return the coefficient of green: the mean over Gr and Gb, or the only one.

    Raises:
        RequestError: the coefficient is missing, or not a number.
    """
    found = re.search(f"noise_model_{key}{_COEFFICIENTS}", text)
    if not found:
        raise RequestError(
            f"{path}: noise_model_{key} = {{ ... }} is missing; an Android noise model has "
            "noise_model_A, _B, _C and _D"
        )
    planes = [_number(part) for part in found[1].split(",") if part.strip()]
    if len(planes) not in (1, 4) or not all(map(math.isfinite, planes)):
        raise RequestError(
            f"{path}: noise_model_{key} is {found[1].strip()!r}, but expected one number for "
            "all channels, or four numbers for R, Gr, Gb and B"
        )
    return planes[0] if len(planes) == 1 else (planes[1] + planes[2]) / 2


def _number(text: str) -> float:
    """Return the number in a text, or NaN."""
    try:
        return float(text)
    except ValueError:
        return math.nan


def _isos(text: str, highest: float) -> tuple[list[float], str]:
    """Return the lowest and highest ISO with full stops between, and a note on assumed values."""
    if found := _RANGE.search(text):
        low, high = sorted((max(float(found[1]), 1.0), max(float(found[2]), 1.0)))
        source = ""
    else:
        low, high = 100.0, max(1600.0, highest if math.isfinite(highest) else 0.0)
        source = f"; its ISOs are not stated; assumed: {low:g} to {high:g}"
    stops = (100 * 2.0**n for n in range(-7, 24))
    return sorted({low, *(stop for stop in stops if low < stop < high), high}), source
