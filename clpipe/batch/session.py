"""A run: images through a chain, from what is asked for to the outcome of each image.

The commands that make pictures and :func:`clpipe.run` all go this way.
"""

import logging
import secrets
import threading
import time
from collections.abc import Callable, Generator, Iterable, Iterator, Sequence
from contextlib import AbstractContextManager, ExitStack, closing, nullcontext
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING

from clpipe.base.about import full_version
from clpipe.base.buckets import upload, url_of
from clpipe.base.errors import OutputError, RequestError
from clpipe.base.files import check_folder, discard
from clpipe.base.processors import available_processors
from clpipe.batch.outcome import Outcome
from clpipe.batch.processes import Processes, usual_processes
from clpipe.batch.remote_tars import RemoteTars
from clpipe.batch.run_log import RunLog, Summary, log_name
from clpipe.batch.spec import RunSpec
from clpipe.batch.tar_batch import TarBatch
from clpipe.batch.tars import Tar, cut
from clpipe.batch.threads import Batch
from clpipe.batch.trace import Trace, check_trace
from clpipe.batch.where import Where
from clpipe.batch.work import ImageWorker
from clpipe.chain.isos import draw_note
from clpipe.chain.request import Request
from clpipe.engine.device import Device, open_devices
from clpipe.images.claims import Claim
from clpipe.images.read import PICTURE_SUFFIXES
from clpipe.inputs.find import Job, Shard, find_jobs
from clpipe.inputs.lenses import lens_notes
from clpipe.inputs.loader import ImageLoader
from clpipe.inputs.poses import with_views
from clpipe.inputs.series import Series
from clpipe.outputs.folder import output_folder, remove_unfinished
from clpipe.outputs.gone import pictures_without_input
from clpipe.outputs.writer import OutputWriter
from clpipe.stage import Kind

if TYPE_CHECKING:
    from clpipe.batch.dask_client import Cluster


log = logging.getLogger(__name__)


@dataclass(frozen=True)
class Images:
    """Which images a run is about.

    Args:
        inputs: files, folders, globs and manifests.
        exclude: patterns of what is not taken from folders and globs.
        poses: the file of the renders' cameras; None where they are not known.
        series: cameras and ISOs, each of which makes pictures of its own.
        shard: the part of them that is done.
        per_tar: how many are packed into a tar; None is no tars.
        found: images that are known already, in place of inputs.
    """

    inputs: Sequence[str] = ()
    exclude: Sequence[str] = ()
    poses: Path | None = None
    series: Series = field(default_factory=Series)
    shard: Shard = field(default_factory=Shard)
    per_tar: int | None = None
    found: Sequence[Job] = ()

    @property
    def is_whole(self) -> bool:
        """Whether the output folder has all of the run's pictures, as files, when it has ended."""
        return bool(self.inputs) and not self.per_tar and self.shard.of == 1

    def jobs(self, loader: ImageLoader, output: Path) -> tuple[list[Job], list[Tar]]:
        """The jobs of the run's part, and the tars that they go into.

        Raises:
            RequestError: an input, a camera or an ISO is not there, or a name is there twice.
        """
        jobs = self.found
        if not jobs:
            found = find_jobs(self.inputs, output, loader.endings(), self.exclude)
            jobs = loader.exposures(found)
        jobs = with_views(jobs, self.poses, loader.settings.render, loader.request.truth_at)
        jobs = self.series.jobs(jobs, loader.settings)
        if self.per_tar:
            tars = self.shard.take(cut(jobs, self.per_tar, output))
            return [job for tar in tars for job in tar.jobs], tars
        return self.shard.take(jobs), []


class Run:
    """Images through a chain: iterate over it for the outcome of each image, as it is finished.

    All that can be refused is refused when it is made; nothing is written before it is iterated.
    A run is iterated once.

    Args:
        request: what is asked for.
        images: of which images.
        where: with which devices, to which folder.
        dask: the address of a Dask scheduler whose workers do it; None is this machine.
        arguments: what the log says that the run was begun with.
        echo: gets each line of the log, too.

    Attributes:
        images: which images the run is about.
        jobs: the images of the run's part; there may be none.
        summary: counts of what became of them so far.
        notes: what is to be said of the output folder, once the run has ended.

    Raises:
        RequestError: a name or value is not allowed, or a result would overwrite something.
    """

    def __init__(
        self,
        request: Request,
        images: Images,
        where: Where,
        dask: str | None = None,
        arguments: Sequence[str] = (),
        echo: Callable[[bytes], None] | None = None,
    ) -> None:
        # A checkout asks git for the version that log and sidecars have; here nobody waits for it.
        threading.Thread(target=full_version, daemon=True).start()
        check_output(where.output, images.per_tar)
        check_processes(where, dask, images.per_tar)
        self.where = where
        self.notes: list[str] = []
        self.images = images
        self._dask = dask
        self._arguments = arguments
        self._echo = echo
        self._running: Batch | Cluster | Processes | None = None
        self._is_stopped = False
        self._loader = ImageLoader(request)
        self.jobs, self._tars = images.jobs(self._loader, where.output)
        self.summary = Summary(len(self.jobs))
        if not self.jobs:
            return
        self._loader.check(self.jobs)
        if note := draw_note(self._loader.settings):
            log.info("%s", note)
        self._chain = self._loader.first_chain(self.jobs)
        for note in lens_notes(self._loader.settings, self.jobs):
            log.warning("%s", note)
        check_render_options(request, self._chain.source)
        self._request = request.with_outputs(self._chain)
        self.writer = OutputWriter(where.output, self._request)
        self.writer.check(self._chain, self.jobs)
        if where.trace:
            check_trace(where.trace)
        if self._tars and dask is not None:
            raise RequestError("--dask: it makes no tars; use --webdataset with --shard")

    def __iter__(self) -> Iterator[Outcome]:
        return self.outcomes(self.jobs)

    def stop(self) -> None:
        """Let no more images in; those in flight are finished. May be called by a signal."""
        self._is_stopped = True
        if self._running:
            self._running.stop()

    def outcomes(self, jobs: Iterable[Job]) -> Generator[Outcome, None, None]:
        """The outcome of each image, as it is finished, in any order.

        Args:
            jobs: those of the run, which may come one after the other.

        Raises:
            RequestError: the output folder cannot be used, or the cluster.
            OutputError: nothing can be written any more. What was in flight is reported before.
            DeviceError: on no device is work possible any more.
        """
        if not self.jobs:
            return
        images, where = self.images, self.where
        start = {"arguments": list(self._arguments), "images": len(self.jobs)}
        with ExitStack() as stack:
            batch = self._running = stack.enter_context(self._batch(jobs))
            if self._is_stopped:
                batch.stop()
            stack.enter_context(output_folder(where.output, images.shard))
            folders = images.series.under(where.output) if images.poses and images.is_whole else []
            if folders:
                from clpipe.outputs.camera_files import check_camera_files

                for folder in folders:
                    check_camera_files(folder)
            trace = stack.enter_context(Trace(where.trace)) if where.trace else None
            remove_unfinished(where.output, self.jobs, self._request.patch is not None)
            if url := url_of(where.output):
                stack.callback(discard, where.output)
                stack.callback(self._send_log, url)
            run_log = RunLog(where.output / log_name(images.shard), start, self._echo)
            stack.enter_context(closing(run_log))
            running = stack.enter_context(closing(batch.run(jobs)))
            self.summary.began = time.perf_counter()
            yield from self._counted(running, run_log, trace)
            self._look_behind(folders)

    def _send_log(self, url: str) -> None:
        """Put the log beside the tars, under a name that no other run has."""
        path = self.where.output / log_name(self.images.shard)
        if path.exists():
            began = time.strftime("%Y%m%dT%H%M%S", time.gmtime())
            try:
                upload(path, f"{url}/{path.stem}.{began}-{secrets.token_hex(2)}.jsonl")
            except OutputError as error:  # which is no reason to hide one of the run's own
                log.warning("%s; the log of this run is lost", error)

    def _counted(
        self, running: Iterable[Outcome], log: RunLog, trace: Trace | None
    ) -> Iterator[Outcome]:
        """The outcomes, each counted and noted.

        Raises:
            OutputError: the log cannot be written any more. What is in flight is finished before.
        """
        unlogged: OutputError | None = None
        try:
            for outcome in running:
                self.summary.add(outcome)
                if not unlogged:
                    try:
                        log.add(outcome)
                    except OutputError as error:
                        unlogged = error
                        self.stop()
                if trace:
                    trace.add(outcome)
                yield outcome
            if unlogged:
                raise unlogged
        finally:
            self.summary.interrupted = self.summary.finished < self.summary.total
            if not unlogged:
                log.end(self.summary)

    def _processes(self, jobs: Iterable[Job], claim: Claim) -> int:
        """How many processes do the jobs; the claim is of the first one."""
        where = self.where
        if where.processes:
            return where.processes
        if self._tars or jobs is not self.jobs:  # they may come one after the other
            return 1
        return usual_processes(len(self.jobs), claim, available_processors())

    def _look_behind(self, folders: Sequence[Path]) -> None:
        """Write the views of a run's folders, and note what else there is to say of it."""
        if self.summary.interrupted:
            return
        if folders:
            from clpipe.outputs.camera_files import write_camera_files

            for folder in folders:
                self.notes += write_camera_files(folder).lines(folder)
        if self.images.is_whole and (
            count := pictures_without_input(self.writer, self.jobs, self.images.inputs)
        ):
            pictures, are = ("picture", "is") if count == 1 else ("pictures", "are")
            self.notes.append(
                f"{count} {pictures} in {self.where.output} {are} of inputs that are not there any "
                "more"
            )

    def _batch(self, jobs: Iterable[Job]) -> "AbstractContextManager[Batch | Cluster | Processes]":
        """What does the jobs: this machine, with or without tars, its processes, or a cluster.

        Raises:
            RequestError: the cluster cannot be used.
            DeviceError: there is no usable device.
        """
        if self._dask is not None:
            from clpipe.batch.dask_client import connected
            from clpipe.batch.dask_worker import DaskSpec

            return connected(self._dask, DaskSpec(self._request, self.where, self.jobs[0]))
        where = self.where
        # The first one's size stands for all, whose headers nobody has read.
        claim = self._loader.claim(self.jobs[0])
        if (count := self._processes(jobs, claim)) > 1:
            spec = RunSpec(self._request, where, self.jobs[0])
            return nullcontext(Processes(spec, count, claim))
        devices: list[Device | None] = [*open_devices(where.devices, where.memory)] or [None]
        if self._tars:
            own = self._loader, self.writer, self._chain
            is_remote = url_of(where.output) is not None
            remote = RemoteTars(self._tars, self._request, where.redo) if is_remote else None
            return nullcontext(TarBatch(self._tars, *own, where, devices, remote))
        is_traced = where.trace is not None
        worker = ImageWorker(self._loader, self.writer, self._chain, where.redo, is_traced)
        return nullcontext(Batch(worker, devices, where.threads))


def check_processes(where: Where, dask: str | None, per_tar: int | None) -> None:
    """See that several processes are only asked for where they do the work.

    Raises:
        RequestError: something else does it.
    """
    if where.processes is None or where.processes == 1:
        return
    if dask is not None:
        raise RequestError("--processes: with --dask the cluster's workers are the processes")
    if per_tar:
        raise RequestError(
            "--processes: a tar is packed by one process; run several, each with a --shard"
        )


def check_output(folder: Path, per_tar: int | None = None) -> None:
    """See that the output folder is no file nor called like a picture, and that a URL gets tars.

    Raises:
        RequestError: it is, or gets pictures.
    """
    if (url := url_of(folder)) and not per_tar:
        raise RequestError(
            f"--output: found {url}; behind a URL go tars alone: say --webdataset N as well"
        )
    if folder.suffix.lower() in (*PICTURE_SUFFIXES, ".dng") and not folder.is_dir():
        raise RequestError(
            f"--output: found {folder}, the name of a picture; name the folder to write to: "
            "-o FOLDER"
        )
    check_folder(folder)


def check_render_options(request: Request, source: Kind) -> None:
    """See that options about renders are not set for other images.

    Raises:
        RequestError: one is.
    """
    for option, value in (("--layer", request.layer), ("--transfer", request.transfer)):
        if value is not None and source is not Kind.RGB:
            raise RequestError(f"{option}: it is for renders, but the chain reads {source.label}")
