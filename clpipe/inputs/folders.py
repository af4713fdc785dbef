"""The images in a folder, without hidden and excluded files."""

import logging
import os
from collections import Counter
from collections.abc import Iterator, Sequence
from fnmatch import fnmatchcase
from pathlib import Path

from clpipe.base.errors import RequestError
from clpipe.base.text import printable
from clpipe.images.raw import RAW_SUFFIXES
from clpipe.images.read import PICTURE_SUFFIXES

log = logging.getLogger(__name__)

FINISHED = (
    "Finished pictures are not linear light. For renders, add --transfer srgb; for photographs, "
    "use -c unprocess"
)


class Exclusion:
    """Patterns (* ? []) of paths to skip in input folders, or of file and folder names to skip."""

    def __init__(self, patterns: Sequence[str] = ()) -> None:
        self._patterns = patterns
        self.unused = dict.fromkeys(patterns)  # patterns that have matched nothing so far

    def __bool__(self) -> bool:
        return bool(self._patterns)

    def __contains__(self, path: str) -> bool:
        name = os.path.basename(path)
        matching = [p for p in self._patterns if fnmatchcase(path, p) or fnmatchcase(name, p)]
        for pattern in matching:
            self.unused.pop(pattern, None)
        return bool(matching)


def images_in(
    folder: Path, output: Path, endings: Sequence[str], excluded: Exclusion
) -> list[Path]:
    """Return the images in a folder, at any depth, sorted. The number of other files is logged.

    Hidden files and the output directory are skipped. A dangling link counts as an image, which
    fails later.

    Raises:
        RequestError: a folder cannot be read, or there are no images.
    """
    images: list[Path] = []
    skipped_types: Counter[str] = Counter()
    for parent, names in _walk(folder, output, excluded):
        relative = os.path.relpath(parent, folder)
        for name in names:
            if name.startswith(".") or os.path.normpath(f"{relative}/{name}") in excluded:
                continue
            path = Path(parent, name)
            suffix = path.suffix.lower()
            if suffix in endings and (path.is_file() or path.is_symlink()):
                images.append(path)
            else:
                skipped_types[
                    "pipe or device" if suffix in endings else suffix or "without suffix"
                ] += 1
    summary = summary_of(skipped_types)
    if not images:
        qualifier = " that are not excluded" if excluded else ""
        types = ", ".join(e for e in endings if e not in RAW_SUFFIXES)
        raws = " and camera raws" if set(RAW_SUFFIXES) & set(endings) else ""
        text = f"{folder}: this folder has no images{qualifier}; clpipe looked for {types}{raws}"
        text += f", and the folder has {summary}" if summary else ""
        if skipped_types.keys() & set(PICTURE_SUFFIXES):
            text += f". {FINISHED}"
        raise RequestError(text)
    if skipped_types:
        single = skipped_types.total() == 1
        not_images = "file is not an image" if single else "files are not images"
        were = "was" if single else "were"
        log.info(
            "%s: %d %s and %s skipped: %s", folder, skipped_types.total(), not_images, were, summary
        )
    return sorted(images)


def summary_of(skipped: Counter[str]) -> str:
    """Return the most frequent kinds of skipped files, with their numbers; "" for none."""
    ranked = sorted(skipped.items(), key=lambda item: (-item[1], item[0]))
    kinds = [f"{count} {kind}" for kind, count in ranked[:5]]
    return printable(", ".join(kinds + ["others"] * (len(skipped) > len(kinds))))


def _walk(folder: Path, output: Path, excluded: Exclusion) -> Iterator[tuple[str, list[str]]]:
    """Yield each folder below one, with the names of its files. Links are followed last.

    A file that is also reachable through a link therefore always gets its path without the link.

    Raises:
        RequestError: a folder cannot be read.
    """
    visited: set[str] = set()
    roots = [str(folder)]
    for start in roots:  # the loop appends to roots
        for parent, folders, names in os.walk(start, onerror=_reject_folder):
            real = os.path.realpath(parent)
            if real in visited or (visited and real == os.path.realpath(output)):
                folders.clear()
                continue
            visited.add(real)
            subfolders = {name: os.path.join(parent, name) for name in sorted(folders)}
            kept = [
                n for n, path in subfolders.items() if os.path.relpath(path, folder) not in excluded
            ]
            roots += [subfolders[name] for name in kept if os.path.islink(subfolders[name])]
            folders[:] = kept
            yield parent, names


def _reject_folder(error: OSError) -> None:
    raise RequestError(f"{error.filename}: this folder cannot be read: {error.strerror}") from None
