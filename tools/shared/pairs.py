"""Pictures of real cameras, each with the mean of many pictures of its scene."""

from dataclasses import dataclass
from pathlib import Path

SUFFIXES = (".png", ".jpg", ".jpeg", ".tif", ".tiff")


@dataclass(frozen=True)
class RealPair:
    """A camera's picture, and the mean of many pictures of the same scene."""

    name: str
    camera: str  # the name without the scene's number
    real: Path
    mean: Path


def find_pairs(folder: Path) -> list[RealPair]:
    """Find the pairs of a folder: NAME_real.png and NAME_mean.png, or JPEG or TIFF.

    Raises:
        SystemExit: the folder has no pair, or a picture has no mean.
    """
    found = []
    for real in sorted(folder.glob("*_real.*")):
        if real.suffix.lower() not in SUFFIXES:
            continue
        name = real.stem.removesuffix("_real")
        mean = real.with_name(f"{name}_mean{real.suffix}")
        if not mean.exists():
            raise SystemExit(f"error: {real} has no {mean.name} next to it")
        found.append(RealPair(name, name.rstrip("0123456789").rstrip("_"), real, mean))
    if not found:
        raise SystemExit(f"error: {folder} has no pairs NAME_real.png and NAME_mean.png")
    return found
