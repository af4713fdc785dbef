"""WebDataset shards: the pictures of so many images at a time, with their sidecars, in one tar.

The pictures of a tar are written into a hidden folder of its own, and packed when all are there.
"""

import json
import os
import re
import shutil
import tarfile
import threading
from collections.abc import Generator, Iterator, Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path, PurePosixPath
from typing import Any

from clpipe.base.errors import ImageError, OutputError, RequestError
from clpipe.base.files import write_beside
from clpipe.batch.outcome import DONE, FAILED, SKIPPED, Outcome
from clpipe.batch.threads import Batch
from clpipe.chain.chain import Chain
from clpipe.engine.device import Device
from clpipe.inputs.find import Job
from clpipe.inputs.loader import ImageLoader
from clpipe.outputs.folder import RESUMABLE, remove_unfinished
from clpipe.outputs.formats import SIDECAR
from clpipe.outputs.sidecar import OWN, is_as_wanted, read_sidecar
from clpipe.outputs.writer import OutputWriter, named

STAGING = ".clpipe."  # before the name of a tar: the folder of its pictures until it is packed


NUMBERED = re.compile(rf"({re.escape(STAGING)})?(\d{{6,}})\.tar")


HIDDEN_BY_READERS = re.compile("__[^/]*__/")  # the webdataset package skips such folders


def sample_name(job: Job) -> str:
    """The name of a job's sample: WebDataset ends it at the first dot of the last part.

    >>> sample_name(Job(Path("x"), "shot.1/frame.0001.exr"))
    'shot.1/frame_0001'
    """
    stem = PurePosixPath(job.stem)
    return str(stem.with_name(stem.name.replace(".", "_")))


@dataclass(frozen=True)
class Tar:
    """One shard of a run, which has ``of`` of them; its jobs are named as samples."""

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
        """The folder of its pictures until they are packed."""
        return self.folder / f"{STAGING}{self.name}"


def cut(jobs: Sequence[Job], count: int, folder: Path) -> list[Tar]:
    """The tars of a run, of ``count`` jobs each, in their order.

    Raises:
        RequestError: two jobs would be the same sample, or readers would not see one.
    """
    owners: dict[str, Job] = {}
    for job in jobs:
        name = sample_name(job)
        if name in owners:
            raise RequestError(
                f"{named(owners[name])} and {named(job)} would both be the sample {name} "
                "(a key of WebDataset has no dots); give one of them another name"
            )
        if HIDDEN_BY_READERS.match(name):
            raise RequestError(
                f"{named(job)}: would be the sample {name}, but WebDataset takes a folder "
                "__NAME__ for its own and skips it; give it another name"
            )
        owners[name] = job
    samples = [replace(job, name=name) for name, job in owners.items()]
    parts = [tuple(samples[first : first + count]) for first in range(0, len(samples), count)]
    return [Tar(folder, f"{i:06}.tar", part, len(parts)) for i, part in enumerate(parts)]


def prepare(tars: Sequence[Tar], overwrite: bool) -> None:
    """Clear the output folder of what a killed run left of these tars, and see that they may be
    written; with ``overwrite`` also over tars of others.

    Raises:
        RequestError: a tar is somebody else's, or one of a run with more tars.
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
                "would be read with them; remove it, or choose another output folder"
            )
    for tar in tars:
        if not overwrite and os.path.lexists(tar.path) and not is_own(tar.path):
            raise RequestError(
                f"{tar.path}: clpipe did not write this tar, and would overwrite it; move it, "
                "choose another output folder, or say --overwrite"
            )


def is_own(path: Path) -> bool:
    """Whether a file is a tar whose first JSON is a sidecar."""
    try:
        with tarfile.open(path, "r:") as tar:
            for info in tar:
                if info.name.endswith(f".{SIDECAR}") and (data := tar.extractfile(info)):
                    return OWN in json.load(data)
    except (OSError, tarfile.TarError, ValueError, TypeError):
        pass
    return False


@dataclass(frozen=True)
class Staged(OutputWriter):
    """The same target, but for each picture in the folder of its tar."""

    folders: Mapping[str, str] = field(default_factory=dict)  # by the stem of a job

    def path(self, job: Job, ending: str, name: str = "") -> Path:
        """The output of a job with that ending, until it is packed."""
        return self.folder / self.folders[job.stem] / f"{job.stem}{name}.{ending}"


class Members:
    """What lies where in a tar; nothing where there is none, or behind damage."""

    def __init__(self, path: Path) -> None:
        self._path = path
        self.places: dict[str, tuple[int, int]] = {}  # offset and size, in bytes
        try:
            whole = path.stat().st_size
            with tarfile.open(path, "r:") as tar:
                for info in tar:
                    if info.offset_data + info.size <= whole:
                        self.places[info.name] = (info.offset_data, info.size)
        except (OSError, tarfile.TarError):
            pass

    def sidecar(self, name: str) -> Mapping[str, Any]:
        """A sidecar's values; empty where it is not there, or not whole."""
        if name not in self.places:
            return {}
        start, size = self.places[name]
        try:
            with open(self._path, "rb") as file:
                file.seek(start)
                found = json.loads(file.read(size))
        except (OSError, ValueError):
            return {}
        return found if isinstance(found, dict) else {}


class _Shard:
    """A tar on its way: what it holds from before, and what became of its jobs."""

    def __init__(self, tar: Tar, target: OutputWriter) -> None:
        self._tar = tar
        self._target = target
        self._lock = threading.Lock()
        self._from_before: dict[str, list[str]] = {}  # sidecars, and the files that they name
        self._statuses: dict[str, str] = {}

    @cached_property
    def _old(self) -> Members:
        return Members(self._tar.path)

    def _member(self, job: Job, name: str) -> str:
        path = self._target.path(job, SIDECAR, name)
        return path.relative_to(self._tar.staging).as_posix()

    def has(self, job: Job, name: str, wanted: Mapping[str, Any]) -> bool:
        """Whether the tar holds a picture as it is wanted; it is then taken from there."""
        member = self._member(job, name)
        with self._lock:
            found = self._old.sidecar(member)
        if not found or not is_as_wanted(found, job, wanted):
            return False
        files = [str(PurePosixPath(member).with_name(n)) for n in found["outputs"]]
        if not all(file in self._old.places for file in files):
            return False
        self._from_before[member] = files
        return True

    def shown(self, outcome: Outcome) -> Outcome:
        """An outcome as it is told: with the tar in place of the folder."""
        job = replace(outcome.job, name=f"{self._tar.name}/{outcome.job.stem}")
        outputs = tuple(file.removeprefix(STAGING) for file in outcome.outputs)
        return replace(outcome, job=job, outputs=outputs)

    def add(self, outcome: Outcome) -> bool:
        """Note what became of a job; whether it was the last one."""
        self._statuses[outcome.job.stem] = outcome.status
        return len(self._statuses) == len(self._tar.jobs)

    def pack(self) -> None:
        """Write the tar, where that changes it, and remove the folder of its pictures.

        An image that failed is left out; where others failed too and none is new, the tar stays.

        Raises:
            OutputError: it cannot be written.
        """
        try:
            members = list(self._members())
            new = any(isinstance(source, Path) for _, source in members)
            same = [name for name, _ in members] == list(self._old.places)
            if members and (new or not (same or FAILED in self._statuses.values())):
                write_beside(self._tar.path, lambda to: self._write(to, members))
        except ImageError as error:
            raise OutputError(f"{error}; {RESUMABLE}") from None
        except FileNotFoundError as error:
            raise OutputError(f"{error.filename}: has gone; {RESUMABLE}") from None
        shutil.rmtree(self._tar.staging, ignore_errors=True)

    def _members(self) -> Iterator[tuple[str, Path | tuple[int, int]]]:
        """The names of what belongs into the tar, in order, and where it is: a file, or where in
        the tar from before.
        """
        for job in self._tar.jobs:
            if self._statuses[job.stem] not in (DONE, SKIPPED):
                continue
            for name in self._target.pictures_of(job):
                member = self._member(job, name)
                if files := self._from_before.get(member):
                    for file in (*files, member):
                        yield file, self._old.places[file]
                    continue
                sidecar = self._target.path(job, SIDECAR, name)
                paths = [sidecar.with_name(n) for n in read_sidecar(sidecar)["outputs"]]
                for path in (*paths, sidecar):
                    yield path.relative_to(self._tar.staging).as_posix(), path

    def _write(self, to: Path, members: Sequence[tuple[str, Path | tuple[int, int]]]) -> None:
        with open(to, "wb") as file:
            with tarfile.TarFile(
                fileobj=file, mode="w", format=tarfile.GNU_FORMAT, encoding="utf-8"
            ) as tar:
                for name, source in members:
                    info = tarfile.TarInfo(name)  # mtime, uid and gid are 0, the mode is 0644
                    with open(source if isinstance(source, Path) else self._tar.path, "rb") as data:
                        if isinstance(source, Path):
                            info.size = os.fstat(data.fileno()).st_size
                        else:
                            start, info.size = source
                            data.seek(start)
                        tar.addfile(info, data)
            # Its pictures are removed next: it must outlive a loss of power.
            file.flush()
            os.fsync(file.fileno())


class TarBatch(Batch):
    """A run over many images whose pictures are packed into tars.

    Args:
        tars: which.
        entrance, target, devices, chain, threads, overwrite, trace: as for the base.
    """

    def __init__(
        self,
        tars: Sequence[Tar],
        entrance: ImageLoader,
        target: OutputWriter,
        devices: Sequence[Device | None],
        chain: Chain,
        threads: int | None = None,
        overwrite: bool = False,
        trace: bool = False,
    ) -> None:
        folders = {job.stem: tar.staging.name for tar in tars for job in tar.jobs}
        staged = Staged(**vars(target), folders=folders)
        super().__init__(entrance, staged, devices, chain, threads, overwrite, trace)
        self._tars = tars
        self._folders = folders
        self._shards = {tar.staging.name: _Shard(tar, staged) for tar in tars}

    def _shard_of(self, job: Job) -> _Shard:
        return self._shards[self._folders[job.stem]]

    def is_there(self, job: Job, name: str, wanted: Mapping[str, Any]) -> bool:
        """Whether a picture is there already, in its tar or in the folder that will be one."""
        return self._shard_of(job).has(job, name, wanted) or super().is_there(job, name, wanted)

    def run(self, jobs: Sequence[Job]) -> Generator[Outcome, None, None]:
        """The same; a tar is packed while the next one is made.

        What a killed run left is cleared away first.

        Raises:
            RequestError: as :func:`prepare`.
            OutputError: nothing can be written any more.
            DeviceError: a kernel does not compile.
        """
        prepare(self._tars, self._overwrite)
        packing: Future[None] | None = None
        with ThreadPoolExecutor(1, "pack") as packer:
            for outcome in super().run(jobs):
                shard = self._shard_of(outcome.job)
                is_last = shard.add(outcome)
                yield shard.shown(outcome)
                if is_last:
                    if packing:
                        packing.result()
                    packing = packer.submit(shard.pack)
                    del self._shards[self._folders[outcome.job.stem]]
            if packing:
                packing.result()
