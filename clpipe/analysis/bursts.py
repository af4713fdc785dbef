"""Bursts: groups files that are frames of one scene."""

import re
from collections.abc import Iterator, Sequence
from pathlib import Path

from clpipe.base.errors import RequestError
from clpipe.images.read import PICTURE_SUFFIXES

FRAME = re.compile(r"(.+)\.frame\d+(\..+)")  # the name of a frame from clpipe run --frames

Key = tuple[Path, str, str]  # folder, name and extension of a burst


def bursts_in(paths: Sequence[Path]) -> list[list[Path]]:
    """Return the bursts among files and folders.

    NAME.frame0.png, NAME.frame1.png and so on form a burst. In a folder, and in folders below it,
    there is a burst for each NAME. Without such files, all pictures of a folder form one burst.
    Files that are given directly form one burst, unless all are frames of bursts of two or more.

    Raises:
        RequestError: a folder has no pictures, or frames of several formats.
    """
    files = [path for path in paths if not path.is_dir()]
    bursts = [*by_name(files).values()]
    are_bursts = sum(map(len, bursts)) == len(files) and min(map(len, bursts), default=2) > 1
    if not are_bursts:
        bursts = [files]
    for folder in (path for path in paths if path.is_dir()):
        bursts += bursts_below(folder)
    return bursts


def by_name(files: Sequence[Path]) -> dict[Key, list[Path]]:
    """Return frames by burst, according to their names. Other files are skipped."""
    frames: dict[Key, list[Path]] = {}
    for file in files:
        if match := FRAME.fullmatch(file.name):
            frames.setdefault((file.parent, match[1], match[2]), []).append(file)
    return frames


def bursts_below(folder: Path) -> Iterator[list[Path]]:
    """Yield the bursts in a folder and below.

    Raises:
        RequestError: as for :func:`bursts_in`.
    """
    files = sorted(
        f for f in folder.rglob("*") if f.suffix.lower() in PICTURE_SUFFIXES and f.is_file()
    )
    if not files:
        raise RequestError(f"{folder}: this folder has no pictures ({', '.join(PICTURE_SUFFIXES)})")
    for here in sorted({file.parent for file in files}):
        own = [file for file in files if file.parent == here]
        frames = by_name(own)
        endings = sorted({ending for _, _, ending in frames})
        if len(endings) > 1:
            raise RequestError(
                f"{here}: this folder has frames with the extensions {' and '.join(endings)}; "
                f"choose one of them: {here}/*{endings[0]}"
            )
        yield from frames.values() if frames else [own]
