"""The NoiseProfile of a DNG: a and b of each colour at the file's ISO (DNG 1.4, tag 51041)."""

import math
from pathlib import Path
from typing import Any

from clpipe.analysis.noise_models.model import Law, Levels, SensorModel
from clpipe.base.errors import ImageError
from clpipe.images.raw import read_exif, read_facts

NOISE_PROFILE = "Tag 0xC761"  # as exifread has it


def read_dng(path: Path) -> SensorModel:
    """The noise of the camera of a DNG, from the pair for green, or the one for all colours.

    Raises:
        ImageError: it cannot be read, holds no Bayer mosaic, or does not state its noise, its ISO
            or its levels.
    """
    facts, exif = read_facts(path), read_exif(path)
    tags = (tag for name, tag in exif.tags.items() if name.endswith(NOISE_PROFILE))
    tag = next(tags, None)
    if tag is None:
        raise ImageError(
            f"{path}: has no NoiseProfile (tag 51041), in which a DNG states its noise; DNGs of "
            "Android phones, Adobe's converter and clpipe have one"
        )
    values = _numbers(tag)
    if len(values) not in (2, 6):
        raise ImageError(
            f"{path}: its NoiseProfile has {len(values)} numbers; it needs a and b, for all "
            "colours or for each of three"
        )
    a, b = values[2:4] if len(values) == 6 else values
    if not (math.isfinite(a) and math.isfinite(b) and a > 0 and b > 0):
        raise ImageError(
            f"{path}: its NoiseProfile has a = {a:g} and b = {b:g} for green; both must be above 0"
        )
    if facts.iso is None:
        raise ImageError(f"{path}: does not state its ISO, for which its NoiseProfile holds")
    if not 0 <= facts.black_level < facts.white_level:
        raise ImageError(
            f"{path}: its levels cannot be right: black {facts.black_level}, white "
            f"{facts.white_level}"
        )
    own = exif.color_matrix()
    which = "green" if len(values) == 6 else "all colours"
    return SensorModel(
        facts.make,
        facts.model,
        [Law(facts.iso, a, b)],
        f"the DNG's NoiseProfile at ISO {facts.iso:g}, {which}: a = {a:.6g}, b = {b:.6g}",
        Levels(facts.black_level, facts.white_level, "as the DNG states them"),
        in_file=True,
        gains=facts.gains,
        xyz_to_camera=own or facts.xyz_to_camera,
        matrix_source="the DNG's ColorMatrix for D65" if own else "LibRaw's for this camera",
    )


def _numbers(tag: Any) -> list[float]:
    """The values of a tag of doubles; exifread has each as a tuple of one."""
    try:
        return [float(v[0] if isinstance(v, tuple) else v) for v in tag.values]
    except (AttributeError, IndexError, TypeError, ValueError, ZeroDivisionError):
        return []
