"""Finds the images of a run in files, folders, globs and manifests, and names their outputs."""

import glob
import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, TypeVar

from clpipe.base.errors import RequestError
from clpipe.images.raw import RAW_SUFFIXES
from clpipe.images.read import RENDER_SUFFIXES
from clpipe.inputs.manifest import MANIFEST_SUFFIXES, read_manifest

T = TypeVar("T")


@dataclass(frozen=True)
class Job:
    """One image to make pictures of.

    Args:
        path: the file.
        key: its name among the inputs, from which draws and the names of outputs follow.
        name: the path of its outputs in the output folder, without an ending; "" follows the key.
        listed: whether it was named, matched or in a manifest, and not found in a folder.
        values: settings that hold for it alone, nested as in a configuration.
        frames: how many frames are made of it; None is what the request says.
        place: the manifest and the row that it stands in; "" where it is in none.
        pictures: names of the renditions to make; None is all.
        written: the path as the user wrote it, where ``path`` has been made absolute.
    """

    path: Path
    key: str
    name: str = ""
    listed: bool = True
    values: Mapping[str, Any] = field(default_factory=dict)
    frames: int | None = None
    place: str = ""
    pictures: tuple[str, ...] | None = None
    written: str = ""

    @property
    def input(self) -> str:
        """The path as it is stored and printed."""
        return self.written or str(self.path)

    @property
    def stem(self) -> str:
        """The path of its outputs in the output folder, without an ending."""
        return self.name or str(Path(self.key).with_suffix(""))

    @property
    def label(self) -> str:
        """The job as an error names it."""
        return f"{self.path} ({self.place})" if self.place else str(self.path)


def find_jobs(
    inputs: Sequence[str], output: Path, endings: Sequence[str] = (*RENDER_SUFFIXES, *RAW_SUFFIXES)
) -> list[Job]:
    """The jobs of a run, in the order of its inputs.

    The key of a file in a folder is its path relative to that folder; that of a file which is
    named or matches a glob is its name; a manifest's rows have their own. A missing file is a job,
    too: it fails later, alone.

    Args:
        inputs: files, folders (all images in them, at any depth), globs and manifests.
        output: the output folder; where it lies inside an input folder, its files are no inputs.
        endings: of the files that are taken from folders.

    Raises:
        RequestError: no input, an empty name, a folder without images, a glob that no file matches,
            or a manifest that is wrong.
    """
    jobs: list[Job] = []
    if not inputs:
        raise RequestError("there is no input; give files, folders, globs or manifests")
    for text in inputs:
        if not text:
            raise RequestError("an input is empty; give files, folders, globs or manifests")
        path = Path(text)
        if os.path.isdir(text):
            files = images_in(path, output, endings)
            if not files:
                listed = ", ".join(e for e in endings if e not in RAW_SUFFIXES)
                raws = " and camera raws" if set(RAW_SUFFIXES) & set(endings) else ""
                raise RequestError(f"{path}: a folder without images (looked for {listed}{raws})")
            jobs += [Job(p, p.relative_to(path).as_posix(), listed=False) for p in files]
        elif path.suffix.lower() in MANIFEST_SUFFIXES:
            jobs += [
                Job(row.path, row.key, row.name, True, row.values, row.frames, row.place)
                for row in read_manifest(path)
            ]
        elif glob.has_magic(text) and not os.path.exists(text):
            matches = sorted(m for m in glob.glob(text, recursive=True) if os.path.isfile(m))
            if not matches:
                raise RequestError(f"{text}: no file matches")
            jobs += [Job(Path(m), Path(m).name) for m in matches]
        else:
            jobs.append(Job(path, path.name))
    return jobs


def images_in(folder: Path, output: Path, endings: Sequence[str]) -> list[Path]:
    """The images in a folder at any depth, sorted; links are followed.

    Hidden files and the output folder are left out. A link that leads nowhere is an image, too: it
    fails later.
    """
    images: list[Path] = []
    visited: set[str] = set()
    for place, folders, names in os.walk(folder, followlinks=True):
        real = os.path.realpath(place)
        if real in visited or (visited and real == os.path.realpath(output)):
            folders.clear()
            continue
        visited.add(real)
        images += [
            Path(place, n)
            for n in names
            if not n.startswith(".") and os.path.splitext(n)[1].lower() in endings
        ]
    return sorted(p for p in images if p.is_file() or p.is_symlink())


@dataclass(frozen=True)
class Shard:
    """One part of a run: every ``of``-th job or tar, from the ``number``-th on, counted from 1."""

    number: int = 1
    of: int = 1

    def take(self, jobs: Sequence[T]) -> list[T]:
        """The items of this part.

        >>> [job.key for job in Shard(2, 3).take([Job(Path(k), k) for k in "abcde"])]
        ['b', 'e']
        """
        return list(jobs[self.number - 1 :: self.of])


def parse_shard(text: str) -> Shard:
    """A shard from I/N.

    >>> parse_shard("2/3")
    Shard(number=2, of=3)

    Raises:
        RequestError: the text does not have that form.
    """
    number, slash, of = text.partition("/")
    right = slash and number.isdecimal() and of.isdecimal()
    if not right or not 1 <= int(number) <= int(of) <= 1_000_000:
        raise RequestError(f"--shard: found {text!r}; expected I/N, such as 1/8, I from 1 to N")
    return Shard(int(number), int(of))
