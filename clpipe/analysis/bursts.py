"""Bursts: which files show one scene, as frames of it."""

import re
from collections.abc import Iterator, Sequence
from pathlib import Path

from clpipe.base.errors import RequestError
from clpipe.images.read import PICTURE_SUFFIXES

FRAME = re.compile(r"(.+)\.frame\d+(\..+)")  # the name of a frame, as --frames of clpipe run has it

Key = tuple[Path, str, str]  # folder, name and ending of a burst


def bursts_in(paths: Sequence[Path]) -> list[list[Path]]:
    """The bursts among files and folders.

    A folder holds, itself and in folders below, a burst for each NAME of NAME.frame0.png,
    NAME.frame1.png and so on; where it has no such files, all of its pictures are one. Files are
    bursts where each is called so and none is alone; else they are one burst together.

    Raises:
        RequestError: a folder holds no pictures, or frames of several formats.
    """
    bursts: list[list[Path]] = []
    files = [path for path in paths if not path.is_dir()]
    frames = by_name(files)
    if (
        frames
        and sum(map(len, frames.values())) == len(files)
        and min(map(len, frames.values())) > 1
    ):
        bursts += frames.values()
    elif files:
        bursts.append(files)
    for folder in (path for path in paths if path.is_dir()):
        bursts += bursts_below(folder)
    return bursts


def by_name(files: Sequence[Path]) -> dict[Key, list[Path]]:
    """Frames by the burst that their names say; other files are left out."""
    frames: dict[Key, list[Path]] = {}
    for file in files:
        if match := FRAME.fullmatch(file.name):
            frames.setdefault((file.parent, match[1], match[2]), []).append(file)
    return frames


def bursts_below(folder: Path) -> Iterator[list[Path]]:
    """The bursts in a folder and below.

    Raises:
        RequestError: as :func:`bursts_in`.
    """
    files = sorted(
        f for f in folder.rglob("*") if f.suffix.lower() in PICTURE_SUFFIXES and f.is_file()
    )
    if not files:
        raise RequestError(f"{folder}: it holds no pictures ({', '.join(PICTURE_SUFFIXES)})")
    for here in sorted({file.parent for file in files}):
        own = [file for file in files if file.parent == here]
        frames = by_name(own)
        endings = sorted({ending for _, _, ending in frames})
        if len(endings) > 1:
            raise RequestError(
                f"{here}: it holds frames that end in {' and in '.join(endings)}; "
                f"name those of one ending: {here}/*{endings[0]}"
            )
        yield from frames.values() if frames else [own]
