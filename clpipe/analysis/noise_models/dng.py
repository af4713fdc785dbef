"""Reads the NoiseProfile of a DNG: a and b of each colour at its ISO (DNG 1.4, tag 51041)."""

import math
from pathlib import Path

from clpipe.analysis.noise_models.model import Law, Levels, SensorModel
from clpipe.base.errors import ImageError
from clpipe.images.raw import read_exif, read_raw_info

NOISE_PROFILE = 51041  # tag


def read_dng(path: Path) -> SensorModel:
    """Return the noise of a DNG's camera, from the values for green, or those for all colours.

    Raises:
        ImageError: the DNG cannot be read, is not a Bayer mosaic, or does not state its noise, ISO
            or levels.
    """
    facts, exif = read_raw_info(path), read_exif(path)
    values = [each for each in exif.values(NOISE_PROFILE) if isinstance(each, float)]
    if not values:
        raise ImageError(
            f"{path}: this DNG has no NoiseProfile (tag 51041); give a DNG from an Android "
            "phone, Adobe's converter or clpipe"
        )
    if len(values) not in (2, 6):
        raise ImageError(
            f"{path}: its NoiseProfile has {len(values)} numbers; expected 2 (a and b for all "
            "colours) or 6 (a and b for each of three colours)"
        )
    a, b = values[2:4] if len(values) == 6 else values
    if not (math.isfinite(a) and math.isfinite(b) and a > 0 and b > 0):
        raise ImageError(
            f"{path}: its NoiseProfile has a = {a:g} and b = {b:g} for green; both must be above 0"
        )
    if facts.iso is None:
        raise ImageError(
            f"{path}: this DNG does not state the ISO to which its NoiseProfile applies"
        )
    if not 0 <= facts.black_level < facts.white_level:
        raise ImageError(
            f"{path}: its levels are impossible: black {facts.black_level}, white "
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
