"""The sink that packs pictures into WebDataset tars.

The pictures of a tar are first written to a hidden directory, and packed when all are there.
"""

import hashlib
import os
import shutil
import tarfile
import threading
from collections.abc import Generator, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from io import BytesIO
from pathlib import Path, PurePosixPath
from typing import Any

from clpipe.base.errors import ImageError, OutputError
from clpipe.base.files import Stored, atomic_file, sync_folder, unsynced_files
from clpipe.batch.outcome import DONE, FAILED, SKIPPED, Outcome
from clpipe.batch.sinks import Executor, GroupSink
from clpipe.batch.tars import OF_PATCHES, STAGING, Members, Tar, prepare
from clpipe.chain.rendition import Rendition
from clpipe.inputs.find import Job
from clpipe.outputs.existing import ExistingFiles, Redo, find_existing, match_sidecar
from clpipe.outputs.folder import RESUMABLE
from clpipe.outputs.record import patch_text
from clpipe.outputs.sidecar import SIDECAR, output_entries, read_sidecar
from clpipe.outputs.writer import OutputWriter

# The bytes of a member. They are a file, an offset and size in the old tar, or the bytes
# themselves.
Source = Path | tuple[int, int] | bytes

# Bytes to copy at a time; tarfile's default of 16 KiB takes three times as long.
COPY_BYTES = 1 << 20


@dataclass(frozen=True)
class StagedWriter(OutputWriter):
    """A writer that puts each picture into the directory of its tar."""

    folders: Mapping[str, str] = field(default_factory=dict)  # folders by the stem of a job

    def name(self, job: Job, ending: str) -> str:
        """Return the name of a job's file before it is packed."""
        return f"{self.folder}/{self.folders[job.stem]}/{job.stem}{ending}"

    def shared_place(self, sidecar: Path) -> Path:
        """Return the path of a sidecar's tar or clip, next to the file that pictures share."""
        parts = sidecar.relative_to(self.folder).parts
        return self.folder / next(p for p in parts if p.startswith(STAGING)).removeprefix(STAGING)

    def write(self, *arguments: Any) -> dict[Path, Stored]:
        """Write the images of one rendition. They go into the tar, so they need no fsync."""
        with unsynced_files():
            return super().write(*arguments)


class Packer:
    """Packs one tar: members that an earlier run left in it, and the files of its jobs."""

    def __init__(self, tar: Tar, writer: OutputWriter) -> None:
        self.tar = tar
        self._writer = writer
        self._lock = threading.Lock()  # lets one thread read the old tar's index, once
        # Files of the old tar that stay in the new one, by their sidecar.
        self._reused: dict[str, list[str]] = {}
        self.statuses: dict[str, str] = {}  # status of each job, by its stem

    @cached_property
    def _old(self) -> Members:
        return Members(self.tar.path)

    def _member(self, job: Job, rendition: Rendition) -> str:
        """Return the name of a rendition's sidecar in the tar."""
        folder = OF_PATCHES if self._writer.patches else ""
        return folder + self._member_name(self._writer.path(job, SIDECAR, rendition))

    def _member_name(self, path: Path) -> str:
        return path.relative_to(self.tar.staging).as_posix()

    def found(
        self, job: Job, rendition: Rendition, request: Mapping[str, Any], redo: Redo
    ) -> ExistingFiles:
        """Return whether the tar holds a rendition of the same request. If so, it is reused.

        A tar does not say when its files were changed, so their SHA-256 is always compared.
        Arguments as for :func:`clpipe.outputs.existing.find_existing`.
        """
        member = self._member(job, rendition)
        with self._lock:
            values = self._old.sidecar(member)
        listed = output_entries(values)
        pictures = {path.name for path in self._writer.files(job, rendition).pictures}
        if not pictures <= listed.keys():
            return ExistingFiles.NOTHING
        found = match_sidecar(values, job, request, redo.verifies)
        if found is ExistingFiles.NOTHING:
            return found
        sidecar_path = PurePosixPath(member.removeprefix(OF_PATCHES))
        files = {str(sidecar_path.with_name(n)): entry for n, entry in listed.items()}
        if any(self._old.sha256(file) != entry["sha256"] for file, entry in files.items()):
            return ExistingFiles.NOTHING
        if redo.keeps(found):
            self._reused[member] = list(files)
        return found

    def add(self, outcome: Outcome) -> bool:
        """Add the outcome of a job. Returns whether it was the last one."""
        self.statuses[outcome.job.stem] = outcome.status
        return len(self.statuses) == len(self.tar.jobs)

    def pack(self) -> None:
        """Write the tar, unless it would stay the same, and remove the directory of its pictures.

        Failed images are not in it. If images failed and none is new, the tar stays as it is.

        Raises:
            OutputError: it cannot be written.
        """
        try:
            members = list(self._members())
            new = any(self._is_new(*member) for member in members)
            same = [name for name, _ in members] == self._old.names
            if members and (new or not (same or FAILED in self.statuses.values())):
                self._write(members)
        except ImageError as error:
            raise OutputError(f"{error}; {RESUMABLE}") from None
        except FileNotFoundError as error:
            raise OutputError(f"{error.filename}: has gone; {RESUMABLE}") from None
        shutil.rmtree(self.tar.staging, ignore_errors=True)

    def _is_new(self, name: str, source: Source) -> bool:
        """Return whether a member differs from the one in the old tar."""
        if isinstance(source, bytes):
            return self._old.sha256(name) != hashlib.sha256(source).hexdigest()
        return isinstance(source, Path)

    def _members(self) -> Iterator[tuple[str, Source]]:
        """Yield the members of the tar, in order."""
        for job in self.tar.jobs:
            if self.statuses[job.stem] in (DONE, SKIPPED):
                members = self._members_of(job)
                yield from self._by_patch(job, members) if self._writer.patches else members

    def _members_of(self, job: Job) -> Iterator[tuple[str, Source]]:
        for rendition in self._writer.renditions_of(job):
            member = self._member(job, rendition)
            if files := self._reused.get(member):
                for file in (*files, member):
                    yield file, self._old.locations[file]
                continue
            sidecar = self._writer.path(job, SIDECAR, rendition)
            for path in (sidecar.with_name(n) for n in output_entries(read_sidecar(sidecar))):
                yield self._member_name(path), path
            yield member, sidecar

    def _by_patch(
        self, job: Job, members: Iterator[tuple[str, Source]]
    ) -> Iterator[tuple[str, Source]]:
        """Yield the members with the files of each patch together, followed by its sidecar."""
        renditions = self._writer.renditions_of(job)
        first, *_ = names = [self._member(job, each) for each in renditions]
        samples: dict[str, list[tuple[str, Source]]] = {}
        for member, source in members:
            if member in names:
                yield member, source
            else:
                key = member[: member.index(".", member.rfind("/") + 1)]
                samples.setdefault(key, []).append((member, source))
        if first in self._reused:
            values = self._old.sidecar(first)
        else:
            values = read_sidecar(self._writer.path(job, SIDECAR, renditions[0]))
        for number, (key, files) in enumerate(samples.items()):
            yield from files
            yield f"{key}.{SIDECAR}", patch_text(values, number)

    def _write(self, members: Sequence[tuple[str, Source]]) -> None:
        with (
            atomic_file(self.tar.path) as file,
            tarfile.TarFile(
                fileobj=file,
                mode="w",
                format=tarfile.GNU_FORMAT,
                encoding="utf-8",
                copybufsize=COPY_BYTES,
            ) as tar,
        ):
            for name, source in members:
                info = tarfile.TarInfo(name)  # mtime, uid and gid are 0, the mode is 0644
                if isinstance(source, bytes):
                    info.size = len(source)
                    tar.addfile(info, BytesIO(source))
                    continue
                with open(source if isinstance(source, Path) else self.tar.path, "rb") as data:
                    if isinstance(source, Path):
                        info.size = os.fstat(data.fileno()).st_size
                    else:
                        start, info.size = source
                        data.seek(start)
                    tar.addfile(info, data)
        sync_folder(self.tar.folder)  # saves the tar before its pictures are removed


class Tars(GroupSink[Packer]):
    """Tars as a sink.

    Args:
        writer: writes the files of a rendition.
        redo: which existing pictures are made again.
        tars: the tars of the run's part.
    """

    def __init__(self, writer: OutputWriter, redo: Redo, tars: Sequence[Tar]) -> None:
        folders = {job.stem: tar.staging.name for tar in tars for job in tar.jobs}
        staged = StagedWriter(writer.folder, writer.request, folders)
        super().__init__(staged, redo)
        self.tars = tars
        self._folders = folders
        self._packers = {tar.staging.name: Packer(tar, staged) for tar in tars}

    def found(self, job: Job, rendition: Rendition, request: Mapping[str, Any]) -> ExistingFiles:
        """Return what exists of a rendition, in its tar or in the directory that will be packed."""
        packed = self.group(job).found(job, rendition, request, self.redo)
        if packed is not ExistingFiles.NOTHING:
            return packed
        # Without fsync, a power failure may leave a file with its size and time, but without its
        # bytes. The mark that identifies the writer may be missing as well.
        files = self.writer.files(job, rendition)
        return find_existing(files, job, request, verify=True, is_exclusive=True)

    def receive(self, executor: Executor, jobs: Iterable[Job]) -> Generator[Outcome, None, None]:
        """Let an executor do the jobs, and yield their outcomes. Remnants are removed first.

        Raises:
            RequestError: a tar that would be overwritten is not ours, see :func:`prepare`.
            DeviceError: no device is usable.
            OutputError: nothing more can be written.
        """
        prepare(self.tars, self.redo is Redo.ALL)
        yield from super().receive(executor, jobs)

    def group(self, job: Job) -> Packer:
        return self._packers[self._folders[job.stem]]

    def named(self, outcome: Outcome) -> Outcome:
        job = replace(outcome.job, name=f"{self.group(outcome.job).tar.name}/{outcome.job.stem}")
        outputs = tuple(file.removeprefix(STAGING) for file in outcome.outputs)
        return replace(outcome, job=job, outputs=outputs)

    def finish(self, group: Packer, outcomes: list[Outcome]) -> list[Outcome]:
        self.pack(group)
        named = [*map(self.named, outcomes)]
        del self._packers[group.tar.staging.name]
        return named

    def pack(self, packer: Packer) -> None:
        """Write a tar.

        Raises:
            OutputError: it cannot be written.
        """
        packer.pack()
