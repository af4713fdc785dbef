"""Converts darktable's noiseprofiles.json, which describes noise after demosaicing, to raw noise.

Its Var[y] = a*y + b applies after demosaicing, and its estimator is 4 times too low. Therefore a of
raw green is 12.8 times the file's a of green. For six cameras of known gain (Wei et al. 2020; Hanji
et al. 2020) the factor is 9 to 16 at ISO 800 and above. Below that, the file's a is too high. Its b
cannot be converted.
"""

import re
from collections.abc import Iterator
from difflib import get_close_matches
from pathlib import Path
from statistics import median
from typing import Annotated, Any

from pydantic import BaseModel, Field, TypeAdapter, ValidationError

from clpipe.analysis.noise_models.model import FOURTEEN_BITS, Law, SensorModel
from clpipe.base.errors import RequestError
from clpipe.base.text import one_line
from clpipe.base.validation import first_fault
from clpipe.camera.profile import built_in_name, load_camera
from clpipe.camera.text import normalized_name

MARK = "noiseprofiles"
RAW_OVER_DEMOSAICED = 12.8
TRUSTED_ISO = 800.0  # the factor is accurate at this ISO and above
LOWEST_ISO = 100.0  # lower ISOs are often ISO 100 with another exposure
# Relative uncertainty of the factor; if a/ISO deviates more, raws are scaled or denoised.
UNCERTAINTY = 0.3

# Fujifilm's X-Trans cameras (source: rawspeed's cameras.xml); X-T100 and X-T200 are Bayer.
X_TRANS = re.compile(r"X-(?:E|H|M|Pro)\d.*|X-S\d\d|X-T\d\d?(?: II)?|X100[STFV].*|X[237]0|XQ\d")

Slope = Annotated[float, Field(gt=0, le=1, allow_inf_nan=False)]


class Profile(BaseModel):
    """The noise at an ISO; ``skip`` marks a profile that darktable does not use."""

    iso: Annotated[float, Field(gt=0, le=1e9, allow_inf_nan=False)]
    a: tuple[Any, Slope, Any]  # red, green and blue; red and blue depend on the light
    skip: bool = False


def parse_darktable(values: Any, path: Path, camera: str | None) -> SensorModel:
    """Return the noise of a camera from the values of the file.

    Args:
        values: the values of the JSON.
        path: the file, for messages.
        camera: make and model, or any name of a built-in camera; None is the only camera.

    Raises:
        RequestError: there is no such camera, or the file is not in darktable's format.
    """
    cameras = {normalized_name(f"{entry[0]} {entry[1]}"): entry for entry in _all(values)}
    if not cameras:
        raise RequestError(f"{path}: its noiseprofiles list no camera; give darktable's own file")
    make, model, profiles = cameras[_chosen(cameras, path, camera)]
    try:
        checked = TypeAdapter(list[Profile]).validate_python(profiles)
    except ValidationError as error:
        fault = first_fault(error)
        raise RequestError(f"{path}: {make} {model}: profiles{fault.key}: {fault.text}") from None
    if X_TRANS.fullmatch(model):
        raise RequestError(
            f"{path}: {make} {model} has an X-Trans pattern. darktable measured its noise "
            "after a different demosaicing, so clpipe cannot convert the profile; use the "
            "built-in camera fujifilm-x-t3"
        )
    slopes: dict[float, float] = {}
    for profile in sorted(checked, key=lambda profile: profile.iso):
        if not profile.skip:
            slopes.setdefault(profile.iso, profile.a[1] * RAW_OVER_DEMOSAICED)
    slopes = {iso: a for iso, a in slopes.items() if iso >= LOWEST_ISO} or slopes
    if not slopes:
        raise RequestError(f"{path}: {make} {model} has no profiles; choose another camera")
    slopes, how = _plausible(slopes)
    source = (
        f"darktable's noiseprofiles.json, {make} {model}, noise after demosaicing: a of raw green "
        f"= {RAW_OVER_DEMOSAICED} * its green a, +-{UNCERTAINTY * 100:.0f} % (9 to 16 for six "
        f"cameras of known gain){how}"
    )
    laws = [Law(iso, a, None) for iso, a in slopes.items()]
    return SensorModel(make, model, laws, source, FOURTEEN_BITS)


def _plausible(slopes: dict[float, float]) -> tuple[dict[float, float], str]:
    """Return a by ISO, corrected, and a description of the corrections.

    Below the trusted ISOs, a becomes proportional to the ISO. Trusted ISOs whose a/ISO is far from
    the median are excluded. Without trusted ISOs, a does not change.

    >>> _plausible({100.0: 9.0, 800.0: 8.0, 1250.0: 4.0, 1600.0: 16.0})[0]
    {100.0: 1.0, 800.0: 8.0, 1600.0: 16.0}
    """
    per_iso = {iso: a / iso for iso, a in slopes.items() if iso >= TRUSTED_ISO}
    if not per_iso:
        return slopes, ""
    middle = median(per_iso.values())
    far = [iso for iso, one in per_iso.items() if abs(one / middle - 1) > UNCERTAINTY]
    kept = {iso: a for iso, a in slopes.items() if iso not in far}
    lowest = next((iso for iso in kept if iso >= TRUSTED_ISO), None)
    if lowest is None:  # two values contradict each other
        return slopes, ""
    kept |= {iso: kept[lowest] * iso / lowest for iso in kept if iso < lowest}
    how = f"; below ISO {lowest:g}, where its a is too high, in proportion to the ISO"
    if far:
        numbers = ", ".join(f"{iso:g}" for iso in far)
        how += f"; left out, because a/ISO is far from the others': ISO {numbers}"
    return kept, how


def _all(values: Any) -> Iterator[tuple[str, str, Any]]:
    """Yield maker, model and profiles of each camera. Entries of another form are skipped."""
    for maker in _list(values, MARK):
        make = maker.get("maker") if isinstance(maker, dict) else None
        for each in _list(maker, "models"):
            model = each.get("model") if isinstance(each, dict) else None
            if isinstance(make, str) and isinstance(model, str):
                yield one_line(make), one_line(model), each.get("profiles")


def _list(values: Any, key: str) -> list[Any]:
    value = values.get(key) if isinstance(values, dict) else None
    return value if isinstance(value, list) else []


def _chosen(cameras: dict[str, tuple[str, str, Any]], path: Path, camera: str | None) -> str:
    """Return the key of the requested camera.

    Raises:
        RequestError: no camera was requested, or the file does not have it.
    """
    keys = list(cameras)
    example = " ".join(cameras[keys[0]][:2])
    if camera is None:
        if len(keys) == 1:
            return keys[0]
        raise RequestError(
            f"{path}: this file has {len(keys)} cameras; choose one, such as --camera {example!r}"
        )
    wanted = [normalized_name(camera)]
    if built_in := built_in_name(camera):
        known = load_camera(built_in)
        wanted.append(normalized_name(f"{known.make} {known.model}"))
    models = {normalized_name(model): key for key, (_, model, _) in cameras.items()}
    for name in wanted:
        if name in cameras:
            return name
        if name in models:
            return models[name]
    near = get_close_matches(wanted[0], keys, n=3, cutoff=0.6)
    names = ", ".join(" ".join(cameras[key][:2]) for key in near)
    hint = f"; similar are {names}" if near else f"; one is {example}"
    raise RequestError(f"{path}: camera {camera!r} is not among its {len(keys)} cameras{hint}")
