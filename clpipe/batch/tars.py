"""WebDataset tars: each holds the pictures and sidecars of several images."""

import hashlib
import os
import re
import shutil
import tarfile
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path, PurePosixPath
from typing import Any

from clpipe.base.errors import RequestError
from clpipe.base.reading import TEXT_BYTES, check_regular, read_start
from clpipe.inputs.find import Job
from clpipe.outputs.folder import remove_unfinished
from clpipe.outputs.sidecar import SIDECAR, SidecarError, is_sidecar, parse_sidecar

STAGING = ".clpipe."  # prefix of the directory that holds a tar's pictures until it is packed

NUMBERED = re.compile(rf"({re.escape(STAGING)})?(\d{{6,}})\.tar")

# Exceptions that tarfile raises for a damaged tar, whose header may state an absurd size.
DAMAGED = (OSError, tarfile.TarError, ValueError, OverflowError, MemoryError)

OF_PATCHES = "__clpipe__/"  # the directory of the sidecars of images that are cut into patches

HIDDEN_BY_READERS = re.compile("__[^/]*__/")  # the webdataset package skips these directories


def sample_name(job: Job) -> str:
    """Return the key of a job's sample. WebDataset ends it at the first dot of the last part.

    >>> sample_name(Job(Path("x"), "shot.1/frame.0001.exr"))
    'shot.1/frame_0001'
    """
    stem = PurePosixPath(job.stem)
    return str(stem.with_name(stem.name.replace(".", "_")))


@dataclass(frozen=True)
class Tar:
    """One of the ``of`` tars of a run. Its jobs have the names of samples."""

    folder: Path
    name: str
    jobs: tuple[Job, ...]
    of: int

    @property
    def path(self) -> Path:
        """The file."""
        return self.folder / self.name

    @property
    def staging(self) -> Path:
        """The directory of its pictures until they are packed."""
        return self.folder / f"{STAGING}{self.name}"


def split_into_tars(jobs: Sequence[Job], count: int, folder: Path) -> list[Tar]:
    """Return the tars of a run, with ``count`` jobs each, in the order of the jobs.

    Raises:
        RequestError: two jobs would have the same key, or WebDataset would skip one.
    """
    job_by_sample: dict[str, Job] = {}
    for job in jobs:
        name = sample_name(job)
        if name in job_by_sample:
            raise RequestError(
                f"{job_by_sample[name].label} and {job.label} would both be the sample {name} "
                "(a key of WebDataset has no dots); give one of them another name"
            )
        if HIDDEN_BY_READERS.match(name):
            raise RequestError(
                f"{job.label}: its sample would be called {name}, but WebDataset skips "
                "folders called __NAME__; give the image another name"
            )
        job_by_sample[name] = job
    samples = [replace(job, name=name) for name, job in job_by_sample.items()]
    parts = [tuple(samples[first : first + count]) for first in range(0, len(samples), count)]
    return [Tar(folder, f"{i:06}.tar", part, len(parts)) for i, part in enumerate(parts)]


def prepare(tars: Sequence[Tar], overwrite: bool) -> None:
    """Remove what a killed run left of tars, and check that they may be written.

    Args:
        tars: the tars of this run.
        overwrite: whether tars that clpipe did not write may be overwritten.

    Raises:
        RequestError: clpipe did not write a tar, or it belongs to a run with more tars.
    """
    folder, total = tars[0].folder, tars[0].of
    remove_unfinished(folder, [Job(tar.path, tar.name) for tar in tars])
    for path in sorted(folder.iterdir()):
        match = NUMBERED.fullmatch(path.name)
        if not match or int(match[2]) < total:
            continue
        if match[1]:
            shutil.rmtree(path, ignore_errors=True)
        else:
            raise RequestError(
                f"{path}: is of another run, as this one makes {total} tar{'s' * (total > 1)}, and "
                "would be read with them; remove it, or choose another output directory"
            )
    for tar in tars:
        if not overwrite and os.path.lexists(tar.path) and not is_clpipe_tar(tar.path):
            raise RequestError(
                f"{tar.path}: clpipe did not write this tar, or it is damaged, and would be "
                "overwritten; move it, choose another output directory, or say --redo all"
            )


def is_clpipe_tar(path: Path) -> bool:
    """Return whether a file is a tar of clpipe: its first JSON is a sidecar, or it is all zeros.

    A loss of power may leave zeros.
    """
    try:
        if not read_start(path, tarfile.RECORDSIZE).strip(b"\0"):
            return True
        with tarfile.open(path, "r:") as tar:
            for info in tar:
                is_text = info.isreg() and info.name.endswith(f".{SIDECAR}")
                if is_text and (data := tar.extractfile(info)):
                    text = data.read(TEXT_BYTES)
                    if text.strip(b"\0"):
                        return is_sidecar(text)
    except DAMAGED:
        pass
    return False


class Members:
    """The index of a tar, up to the first damage. A missing tar has no members."""

    def __init__(self, path: Path) -> None:
        self._path = path
        self.names: list[str] = []  # a name may occur twice
        self.locations: dict[str, tuple[int, int]] = {}  # offset and size, in bytes
        try:
            whole = check_regular(path).st_size
            with tarfile.open(path, "r:") as tar:
                for info in tar:
                    if info.offset_data + info.size <= whole:
                        self.names.append(info.name)
                        self.locations[info.name] = (info.offset_data, info.size)
        except DAMAGED:
            pass

    def sidecar(self, name: str) -> Mapping[str, Any]:
        """Return a sidecar's values. They are empty if it is missing or was changed."""
        if name not in self.locations:
            return {}
        start, size = self.locations[name]
        try:
            with open(self._path, "rb") as file:
                file.seek(start)
                return parse_sidecar(file.read(min(size, TEXT_BYTES)), name) or {}
        except (OSError, SidecarError):
            return {}

    def sha256(self, name: str) -> str:
        """Return the SHA-256 of a file, or "" if it is missing or cannot be read."""
        if name not in self.locations:
            return ""
        start, left = self.locations[name]
        digest = hashlib.sha256()
        try:
            with open(self._path, "rb") as file:
                file.seek(start)
                while left > 0 and (part := file.read(min(left, 4 << 20))):
                    digest.update(part)
                    left -= len(part)
        except OSError:
            return ""
        return digest.hexdigest()
