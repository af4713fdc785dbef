"""A batch whose pictures are packed into WebDataset tars.

The pictures of a tar are first written to a hidden folder, and packed when all are there.
"""

import os
import shutil
import tarfile
import threading
from collections.abc import Generator, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path, PurePosixPath
from typing import Any

from clpipe.base.errors import ImageError, OutputError
from clpipe.base.files import keep_names, passing_files, whole_file
from clpipe.batch.outcome import DONE, FAILED, SKIPPED, Outcome
from clpipe.batch.tars import STAGING, Members, Tar, prepare
from clpipe.batch.threads import Batch
from clpipe.batch.work import ImageWorker
from clpipe.chain.chain import Chain
from clpipe.engine.device import Device
from clpipe.inputs.find import Job
from clpipe.inputs.loader import ImageLoader
from clpipe.outputs.existing import is_current
from clpipe.outputs.folder import RESUMABLE
from clpipe.outputs.sidecar import SIDECAR, outputs_in, read_sidecar
from clpipe.outputs.writer import OutputWriter

COPIED = 1 << 20  # bytes at a time; tarfile's 16 KiB take three times as long


@dataclass(frozen=True)
class StagedWriter(OutputWriter):
    """A writer that puts each picture into the folder of its tar."""

    folders: Mapping[str, str] = field(default_factory=dict)  # by the stem of a job

    def path(self, job: Job, ending: str, name: str = "") -> Path:
        """The file of a job with an ending, until it is packed."""
        return self.folder / self.folders[job.stem] / f"{job.stem}{name}.{ending}"


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

    def _member(self, job: Job, name: str) -> str:
        path = self._writer.path(job, SIDECAR, name)
        return path.relative_to(self._tar.staging).as_posix()

    def has(self, job: Job, name: str, request: Mapping[str, Any], verify: bool) -> bool:
        """Whether the tar holds a rendition that was made by the same request; it is then reused.

        A tar does not say when its files were touched, so their SHA-256 is always compared.
        Arguments as for :meth:`clpipe.outputs.existing.Existing.is_done`.
        """
        member = self._member(job, name)
        with self._lock:
            values = self._old.sidecar(member)
        listed = outputs_in(values)
        pictures = {path.name for path in self._writer.existing(job, name).pictures}
        if not pictures <= listed.keys() or not is_current(values, job, request, verify):
            return False
        files = {str(PurePosixPath(member).with_name(n)): was for n, was in listed.items()}
        if any(self._old.sha256(file) != was["sha256"] for file, was in files.items()):
            return False
        self._reused[member] = list(files)
        return True

    def packed(self, outcome: Outcome) -> Outcome:
        """An outcome that names the tar in place of the hidden folder."""
        job = replace(outcome.job, name=f"{self._tar.name}/{outcome.job.stem}")
        outputs = tuple(file.removeprefix(STAGING) for file in outcome.outputs)
        return replace(outcome, job=job, outputs=outputs)

    def add(self, outcome: Outcome) -> bool:
        """Note what became of a job, and say whether it was the last one."""
        self._statuses[outcome.job.stem] = outcome.status
        return len(self._statuses) == len(self._tar.jobs)

    def pack(self) -> None:
        """Write the tar, unless it would stay the same, and remove the folder of its pictures.

        Images that failed are left out. Where some failed and none is new, the tar stays as it is.

        Raises:
            OutputError: it cannot be written.
        """
        try:
            members = list(self._members())
            new = any(isinstance(source, Path) for _, source in members)
            same = [name for name, _ in members] == self._old.names
            if members and (new or not (same or FAILED in self._statuses.values())):
                self._write(members)
        except ImageError as error:
            raise OutputError(f"{error}; {RESUMABLE}") from None
        except FileNotFoundError as error:
            raise OutputError(f"{error.filename}: has gone; {RESUMABLE}") from None
        shutil.rmtree(self._tar.staging, ignore_errors=True)

    def _members(self) -> Iterator[tuple[str, Path | tuple[int, int]]]:
        """The members of the tar, in order: the name of each, and where its bytes are, in a file or
        at an offset and size in the old tar.
        """
        for job in self._tar.jobs:
            if self._statuses[job.stem] not in (DONE, SKIPPED):
                continue
            for name in self._writer.names_of(job):
                member = self._member(job, name)
                if files := self._reused.get(member):
                    for file in (*files, member):
                        yield file, self._old.places[file]
                    continue
                sidecar = self._writer.path(job, SIDECAR, name)
                paths = [sidecar.with_name(n) for n in outputs_in(read_sidecar(sidecar))]
                for path in (*paths, sidecar):
                    yield path.relative_to(self._tar.staging).as_posix(), path

    def _write(self, members: Sequence[tuple[str, Path | tuple[int, int]]]) -> None:
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

    def is_done(self, job: Job, name: str, request: Mapping[str, Any]) -> bool:
        """Whether a rendition is done, in its tar or in the folder that will be packed."""
        packed = self._packers.of(job).has(job, name, request, self._verify)
        # After a loss of power a passing file may have its size and time, but not its bytes.
        return packed or self.writer.existing(job, name).is_done(job, request, verify=True)

    def encode(self, *arguments: Any) -> None:
        """Write one rendition and its sidecar, which pass into the tar."""
        with passing_files():
            super().encode(*arguments)


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
        loader, writer, chain, overwrite, verify, trace: as for
            :class:`clpipe.batch.work.ImageWorker`.
        devices, threads: as for the base.
    """

    def __init__(
        self,
        tars: Sequence[Tar],
        loader: ImageLoader,
        writer: OutputWriter,
        chain: Chain,
        devices: Sequence[Device | None],
        threads: int | None = None,
        overwrite: bool = False,
        verify: bool = False,
        trace: bool = False,
    ) -> None:
        folders = {job.stem: tar.staging.name for tar in tars for job in tar.jobs}
        staged = StagedWriter(writer.folder, writer.request, folders)
        self._tars = tars
        self._overwrite = overwrite
        self._packers = Packers(tars, staged)
        worker = TarWorker(self._packers, loader, staged, chain, overwrite, verify, trace)
        super().__init__(worker, devices, threads)

    def run(self, jobs: Iterable[Job]) -> Generator[Outcome, None, None]:
        """Do every job, as the base does; a tar is packed while the next one is made.

        What a killed run left is removed first.

        Raises:
            RequestError: as :func:`prepare`.
            OutputError: nothing can be written any more.
            DeviceError: a kernel does not compile.
        """
        prepare(self._tars, self._overwrite)
        packing: Future[None] | None = None
        with ThreadPoolExecutor(1, "pack") as pool:
            for outcome in super().run(jobs):
                packer = self._packers.of(outcome.job)
                is_last = packer.add(outcome)
                yield packer.packed(outcome)
                if is_last:
                    if packing:
                        packing.result()
                    packing = pool.submit(packer.pack)
                    self._packers.drop(outcome.job)
            if packing:
                packing.result()
