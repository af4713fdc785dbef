"""A batch whose pictures are packed into WebDataset tars.

The pictures of a tar are first written to a hidden folder, and packed when all are there.
"""

import hashlib
import os
import shutil
import tarfile
import threading
from collections.abc import Generator, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, field, replace
from functools import cached_property
from io import BytesIO
from pathlib import Path, PurePosixPath
from typing import Any

from clpipe.base.errors import ImageError, OutputError
from clpipe.base.files import Stored, keep_names, passing_files, whole_file
from clpipe.batch.outcome import DONE, FAILED, SKIPPED, Outcome
from clpipe.batch.remote_tars import RemoteTars
from clpipe.batch.tars import OF_PATCHES, STAGING, Members, Tar, prepare
from clpipe.batch.threads import Batch, Jobs
from clpipe.batch.where import Where
from clpipe.batch.work import ImageWorker
from clpipe.chain.chain import Chain
from clpipe.chain.rendition import Rendition
from clpipe.engine.device import Device
from clpipe.inputs.find import Job
from clpipe.inputs.loader import ImageLoader
from clpipe.outputs.existing import Found, Redo, find, found_in
from clpipe.outputs.folder import RESUMABLE
from clpipe.outputs.record import patch_text
from clpipe.outputs.sidecar import SIDECAR, outputs_in, read_sidecar
from clpipe.outputs.writer import OutputWriter

# Where the bytes of a member are: in a file, or at an offset and size in the old tar; or they.
Source = Path | tuple[int, int] | bytes

COPIED = 1 << 20  # bytes at a time; tarfile's 16 KiB take three times as long


@dataclass(frozen=True)
class StagedWriter(OutputWriter):
    """A writer that puts each picture into the folder of its tar."""

    folders: Mapping[str, str] = field(default_factory=dict)  # by the stem of a job

    def name(self, job: Job, ending: str) -> str:
        """The name of a job's file, until it is packed."""
        return f"{self.folder}/{self.folders[job.stem]}/{job.stem}{ending}"

    def write(self, *arguments: Any) -> dict[Path, Stored]:
        """Write the images of one rendition, which pass into the tar; its sidecar is to last."""
        with passing_files():
            return super().write(*arguments)


class Packer:
    """Packs one tar: what an earlier run left in it, and what became of its jobs."""

    def __init__(self, tar: Tar, writer: OutputWriter) -> None:
        self._tar = tar
        self._writer = writer
        self._lock = threading.Lock()
        self._reused: dict[str, list[str]] = {}  # sidecars of the tar, and the files that they name
        self._statuses: dict[str, str] = {}

    @cached_property
    def _old(self) -> Members:
        return Members(self._tar.path)

    def _member(self, job: Job, rendition: Rendition) -> str:
        """The name of a rendition's sidecar in the tar."""
        folder = OF_PATCHES if self._writer.patches else ""
        return folder + self._packed_as(self._writer.path(job, SIDECAR, rendition))

    def _packed_as(self, path: Path) -> str:
        return path.relative_to(self._tar.staging).as_posix()

    def found(
        self, job: Job, rendition: Rendition, request: Mapping[str, Any], redo: Redo
    ) -> Found:
        """Whether the tar holds a rendition that was made by the same request.

        If it is kept, it is reused. A tar does not say when its files were touched, so their
        SHA-256 is always compared. Arguments as for
        :func:`clpipe.outputs.existing.find`.
        """
        member = self._member(job, rendition)
        with self._lock:
            values = self._old.sidecar(member)
        listed = outputs_in(values)
        pictures = {path.name for path in self._writer.files(job, rendition).pictures}
        if not pictures <= listed.keys():
            return Found.NOTHING
        found = found_in(values, job, request, redo.verifies)
        if found is Found.NOTHING:
            return found
        beside = PurePosixPath(member.removeprefix(OF_PATCHES))
        files = {str(beside.with_name(n)): was for n, was in listed.items()}
        if any(self._old.sha256(file) != was["sha256"] for file, was in files.items()):
            return Found.NOTHING
        if redo.keeps(found):
            self._reused[member] = list(files)
        return found

    def packed(self, outcome: Outcome) -> Outcome:
        """An outcome that names the tar in place of the hidden folder."""
        job = replace(outcome.job, name=f"{self._tar.name}/{outcome.job.stem}")
        outputs = tuple(file.removeprefix(STAGING) for file in outcome.outputs)
        return replace(outcome, job=job, outputs=outputs)

    def add(self, outcome: Outcome) -> bool:
        """Note what became of a job, and say whether it was the last one."""
        self._statuses[outcome.job.stem] = outcome.status
        return len(self._statuses) == len(self._tar.jobs)

    def pack(self, remote: RemoteTars | None = None) -> None:
        """Write the tar, unless it would stay the same, and remove the folder of its pictures.

        Images that failed are left out. Where some failed and none is new, the tar stays as it is.

        Args:
            remote: what sends it on; None leaves it here.

        Raises:
            OutputError: it cannot be written, or sent.
        """
        try:
            members = list(self._members())
            new = any(self._is_new(*member) for member in members)
            same = [name for name, _ in members] == self._old.names
            if members and (new or not (same or FAILED in self._statuses.values())):
                self._write(members)
        except ImageError as error:
            raise OutputError(f"{error}; {RESUMABLE}") from None
        except FileNotFoundError as error:
            raise OutputError(f"{error.filename}: has gone; {RESUMABLE}") from None
        shutil.rmtree(self._tar.staging, ignore_errors=True)
        if remote:
            remote.send(self._tar, self._statuses)

    def _is_new(self, name: str, source: Source) -> bool:
        """Whether a member is not in the old tar as it is to be."""
        if isinstance(source, bytes):
            return self._old.sha256(name) != hashlib.sha256(source).hexdigest()
        return isinstance(source, Path)

    def _members(self) -> Iterator[tuple[str, Source]]:
        """The members of the tar, in order."""
        for job in self._tar.jobs:
            if self._statuses[job.stem] in (DONE, SKIPPED):
                members = self._members_of(job)
                yield from self._by_patch(job, members) if self._writer.patches else members

    def _members_of(self, job: Job) -> Iterator[tuple[str, Source]]:
        for rendition in self._writer.renditions_of(job):
            member = self._member(job, rendition)
            if files := self._reused.get(member):
                for file in (*files, member):
                    yield file, self._old.places[file]
                continue
            sidecar = self._writer.path(job, SIDECAR, rendition)
            for path in (sidecar.with_name(n) for n in outputs_in(read_sidecar(sidecar))):
                yield self._packed_as(path), path
            yield member, sidecar

    def _by_patch(
        self, job: Job, members: Iterator[tuple[str, Source]]
    ) -> Iterator[tuple[str, Source]]:
        """The same with the files of each patch together, and what is said of it behind them."""
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
            whole_file(self._tar.path) as file,
            tarfile.TarFile(
                fileobj=file,
                mode="w",
                format=tarfile.GNU_FORMAT,
                encoding="utf-8",
                copybufsize=COPIED,
            ) as tar,
        ):
            for name, source in members:
                info = tarfile.TarInfo(name)  # mtime, uid and gid are 0, the mode is 0644
                if isinstance(source, bytes):
                    info.size = len(source)
                    tar.addfile(info, BytesIO(source))
                    continue
                with open(source if isinstance(source, Path) else self._tar.path, "rb") as data:
                    if isinstance(source, Path):
                        info.size = os.fstat(data.fileno()).st_size
                    else:
                        start, info.size = source
                        data.seek(start)
                    tar.addfile(info, data)
        keep_names(self._tar.folder)  # its pictures are removed next


class TarWorker(ImageWorker):
    """A worker whose pictures may be done in a tar."""

    def __init__(self, packers: "Packers", *arguments: Any) -> None:
        super().__init__(*arguments)
        self._packers = packers

    def found(self, job: Job, rendition: Rendition, request: Mapping[str, Any]) -> Found:
        """Whether a rendition is done, in its tar or in the folder that will be packed."""
        packed = self._packers.of(job).found(job, rendition, request, self._redo)
        if packed is not Found.NOTHING:
            return packed
        # After a loss of power a passing file may have its size and time, but not its bytes, and
        # may not even say whose it is.
        files = self.writer.files(job, rendition)
        return find(files, job, request, verify=True, is_ours=True)


class Packers:
    """The packers of all tars of a run that are not packed yet."""

    def __init__(self, tars: Sequence[Tar], writer: StagedWriter) -> None:
        self._folders = writer.folders
        self._packers = {tar.staging.name: Packer(tar, writer) for tar in tars}

    def of(self, job: Job) -> Packer:
        """The packer of a job's tar."""
        return self._packers[self._folders[job.stem]]

    def drop(self, job: Job) -> None:
        """Forget the packer of a job's tar."""
        del self._packers[self._folders[job.stem]]


class TarBatch(Batch):
    """One run over many images whose pictures are packed into tars.

    Args:
        tars: what is made.
        loader, writer, chain: as for :class:`clpipe.batch.work.ImageWorker`.
        where: how the run goes about it.
        devices: as for the base.
        remote: the URL that they go to; None leaves them in their folder.
    """

    def __init__(
        self,
        tars: Sequence[Tar],
        loader: ImageLoader,
        writer: OutputWriter,
        chain: Chain,
        where: Where,
        devices: Sequence[Device | None],
        remote: RemoteTars | None = None,
    ) -> None:
        folders = {job.stem: tar.staging.name for tar in tars for job in tar.jobs}
        staged = StagedWriter(writer.folder, writer.request, folders)
        self._tars = tars
        self._remote = remote
        self._redo = where.redo
        self._packers = Packers(tars, staged)
        worker = TarWorker(
            self._packers, loader, staged, chain, where.redo, where.trace is not None
        )
        super().__init__(worker, devices, where.threads)

    def run(self, jobs: Iterable[Job] | Jobs) -> Generator[Outcome, None, None]:
        """Do every job, as the base does; a tar is packed while the next one is made.

        What a killed run left is removed first.

        Raises:
            RequestError: as :func:`prepare`.
            OutputError: nothing can be written any more.
            DeviceError: a kernel does not compile.
        """
        if self._remote:
            there = [tar for tar in self._tars if not self.is_stopping and self._remote.has(tar)]
            if self.is_stopping:
                return
            self._tars = [tar for tar in self._tars if tar not in there]
            jobs = [job for tar in self._tars for job in tar.jobs]
            for tar in there:
                for job in tar.jobs:
                    yield Outcome(replace(job, name=f"{tar.name}/{job.stem}"), SKIPPED)
            if not jobs:
                return
        prepare(self._tars, self._redo is Redo.ALL)
        packing: Future[None] | None = None
        with ThreadPoolExecutor(1, "pack") as pool:
            for outcome in super().run(jobs):
                packer = self._packers.of(outcome.job)
                is_last = packer.add(outcome)
                yield packer.packed(outcome)
                if is_last:
                    if packing:
                        packing.result()
                    packing = pool.submit(packer.pack, self._remote)
                    self._packers.drop(outcome.job)
            if packing:
                packing.result()
