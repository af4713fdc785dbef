"""A run: from a request to the outcome of each image.

:func:`clpipe.run` and all commands that make pictures use it.
"""

import logging
import os
import threading
import time
from collections.abc import Callable, Generator, Iterable, Iterator, Sequence
from contextlib import AbstractContextManager, ExitStack, closing, nullcontext
from dataclasses import replace
from pathlib import Path

from clpipe.base.about import full_version
from clpipe.base.errors import OutputError, RequestError
from clpipe.base.files import discard
from clpipe.base.processors import available_processors
from clpipe.base.transfers import TRANSFERS
from clpipe.base.urls import url_of
from clpipe.batch.checks import (
    check_clip_chain,
    check_clip_size,
    check_output,
    check_processes,
    check_render_options,
)
from clpipe.batch.clip_sink import Clips
from clpipe.batch.clips import SETTINGS
from clpipe.batch.execution import ExecutionOptions
from clpipe.batch.frames import check_frames
from clpipe.batch.images import Images
from clpipe.batch.metering import metering_ahead
from clpipe.batch.outcome import Outcome, host_name
from clpipe.batch.processes import Processes, default_processes
from clpipe.batch.remote_tars import RemoteTars
from clpipe.batch.run_log import RunLog, Summary, log_name
from clpipe.batch.sinks import Executor, Folder
from clpipe.batch.spec import RunSpec
from clpipe.batch.tar_sink import Tars
from clpipe.batch.threads import Batch
from clpipe.batch.trace import Trace, check_trace
from clpipe.batch.work import ImageWorker
from clpipe.chain.isos import draw_note
from clpipe.chain.python_words import errors_in_python, python_words
from clpipe.chain.request import Request
from clpipe.chain.unused import ImageFacts, unused_values
from clpipe.engine.device import Device, open_devices
from clpipe.engine.state import has_state
from clpipe.inputs.carry_rows import rows_note
from clpipe.inputs.find import Job
from clpipe.inputs.flow import check_flow
from clpipe.inputs.lenses import lens_notes
from clpipe.inputs.loader import ImageLoader
from clpipe.inputs.metering import write_exposures
from clpipe.inputs.sequences import rate_of
from clpipe.outputs.existing import Redo, pictures_without_input
from clpipe.outputs.folder import output_folder, remove_unfinished
from clpipe.outputs.writer import OutputWriter

log = logging.getLogger(__name__)


class Run:
    """A run. Iterate over it to make the images, and to get the outcome of each as it finishes.

    :func:`clpipe.run` returns one.

    >>> import tempfile
    >>> import OpenImageIO as oiio
    >>> import clpipe
    >>> folder = tempfile.TemporaryDirectory()
    >>> render = oiio.ImageBufAlgo.fill((0.2, 0.3, 0.4), oiio.ROI(0, 32, 0, 24, 0, 1, 0, 3))
    >>> _ = render.write(f"{folder.name}/a.exr")
    >>> run = clpipe.run(f"{folder.name}/a.exr", f"{folder.name}/out", device="numpy")
    >>> len(run.jobs)
    1
    >>> [outcome.status for outcome in run]
    ['done']
    >>> folder.cleanup()

    The constructor checks everything that can be checked early. Nothing is written before you
    iterate, which you can do once.

    Args:
        request: the pictures to make.
        images: the images to make them of.
        execution: the output directory and the devices.
        dask: the address of a Dask scheduler whose workers do the work. None is this machine.
        arguments: command-line arguments for the log.
        echo: also called with each line of the log.

    Attributes:
        images: the images of the run.
        jobs: the images of this part of the run; may be empty.
        summary: counts of outcomes so far.
        notes: remarks about the output directory, complete when the run has ended.
        watch: called when ``summary.waiting`` changes.

    Raises:
        RequestError: a name or value is not allowed, or a result would overwrite something.
    """

    def __init__(
        self,
        request: Request,
        images: Images,
        execution: ExecutionOptions,
        dask: str | None = None,
        arguments: Sequence[str] = (),
        echo: Callable[[bytes], None] | None = None,
    ) -> None:
        # In a checkout, the version comes from git, which takes time. Nothing waits for the version
        # here.
        threading.Thread(target=full_version, daemon=True).start()
        check_output(execution.output, images.per_tar)
        check_processes(execution, dask, bool(images.per_tar), bool(images.clips))
        self.execution = execution
        self.notes: list[str] = []
        self.images = images
        self._dask = dask
        self._arguments = arguments
        self._echo = echo
        self._running: Executor | None = None
        self._is_stopped = False
        self._is_active = False  # whether images are made
        self.watch: Callable[[], None] = lambda: None
        self._loader = ImageLoader(request)
        self.jobs, self._tars = images.jobs(self._loader, execution.output)
        self.summary = Summary(len(self.jobs))
        if not self.jobs:
            return
        self._loader.check(self.jobs)
        if note := draw_note(self._loader.settings):
            log.info("%s", note)
        self._chain = self._loader.first_chain(self.jobs)
        for note in lens_notes(self._loader.settings, self.jobs):
            log.warning("%s", note)
        if note := rows_note(self._loader.request, self._chain):
            log.warning("%s", note)
        if images.sequence:
            check_flow(self._loader, self.jobs)
        check_frames(self._chain, images.sequence, execution, dask)
        if not images.known_jobs:  # otherwise another run has named them
            rate = rate_of(self.jobs[0]) or (images.clips.video.rate if images.clips else None)
            needs_rows = request.truth_at == "rows"
            facts = ImageFacts(images.sequence, needs_rows=needs_rows, rate=rate)
            for note in unused_values(self._loader.settings, self._chain, facts):
                log.warning("%s", note)
        check_render_options(request, self._chain.source)
        self._request = request.with_outputs(self._chain)
        self.writer = OutputWriter(execution.output, self._request)
        self.writer.check(self._chain, self.jobs)
        if images.clips:
            check_clip_chain(self._chain)
            if not self._loader.raw.is_raw(self.jobs[0].path):
                check_clip_size(self._chain, self.jobs[0], images.clips.video)
            self.sink()  # raises an error if two clips would have one name
        if execution.trace:
            check_trace(execution.trace)
        if self._tars and dask is not None:
            raise RequestError("--dask: Dask cannot write tars; use --webdataset with --shard")

    def __iter__(self) -> Iterator[Outcome]:
        with errors_in_python():
            for outcome in self.outcomes(self.jobs):
                yield replace(
                    outcome,
                    error=python_words(outcome.error),
                    warnings=tuple(map(python_words, outcome.warnings)),
                )

    def stop(self) -> None:
        """Begin no more images, and finish those in flight. A signal handler may call it.

        Transfers from and to URLs end within seconds. Images whose files did not arrive have no
        outcome.
        """
        if self._is_active:
            TRANSFERS.stop()
        self._halt()

    def _halt(self) -> None:
        """Begin no more images, but finish transfers."""
        self._is_stopped = True
        if self._running:
            self._running.stop()

    def outcomes(self, jobs: Iterable[Job]) -> Generator[Outcome, None, None]:
        """Make images, and yield the outcome of each as it finishes, in any order.

        Args:
            jobs: jobs of this run. A lazy iterable may block.

        Raises:
            RequestError: the output directory or the cluster cannot be used.
            OutputError: nothing more can be written. Images in flight are reported first.
            DeviceError: no device is usable any more.
        """
        if not self.jobs:
            return
        images, execution = self.images, self.execution
        frames: list[Job] = []
        start = {
            "arguments": list(self._arguments),
            "images": len(self.jobs),
            "tars": len(self._tars),
            "shard": str(images.shard),
            "host": host_name(),
            "pid": os.getpid(),
        }
        with ExitStack() as stack:
            self._is_active = True
            stack.callback(self._end)
            sink = self.sink()
            sink.waiting = self._wait
            executor = self._running = stack.enter_context(self._executor(sink, jobs))
            if self._is_stopped:
                executor.stop()
            if images.sequence:
                jobs = self._metered(executor, sink, jobs, frames)
            stack.enter_context(output_folder(execution.output, images.shard))
            folders = (
                images.series.folders_in(execution.output)
                if images.poses and images.is_whole
                else []
            )
            if folders:
                from clpipe.outputs.camera_files import check_camera_files

                for folder in folders:
                    check_camera_files(folder)
            trace = stack.enter_context(Trace(execution.trace)) if execution.trace else None
            if not images.clips:
                remove_unfinished(execution.output, self.jobs, self._request.patch is not None)
            path = execution.output / log_name(images.shard)
            url = url_of(execution.output)
            if url:
                stack.callback(discard, execution.output)
                names = sink.names if isinstance(sink, RemoteTars) else ()
                start["attempt"] = 1 + sum(name.startswith(f"{path.stem}.2") for name in names)
            run_log = RunLog(path, start, self._echo, url)
            stack.enter_context(closing(run_log))
            if url:
                run_log.begin()  # shows whether the run may write there
            running = stack.enter_context(closing(sink.receive(executor, jobs)))
            self.summary.began = time.perf_counter()
            yield from self._log_outcomes(running, run_log, trace)
            self._finish_folders(folders)
            if frames and not self.summary.interrupted:
                write_exposures(execution.output / self._settings_name(), frames)

    def _settings_name(self) -> str:
        """The name of the file with the settings of all frames."""
        clips = self.images.clips
        if clips and clips.name:
            return f"{clips.name}{clips.suffix}{SETTINGS}"
        return str(Path(log_name(self.images.shard)).with_suffix(".csv"))

    def _end(self) -> None:
        self._is_active = False
        TRANSFERS.allow()

    def _metered(
        self, executor: Executor, sink: Folder, jobs: Iterable[Job], frames: list[Job]
    ) -> Iterator[Job]:
        """Yield frames with the settings of their sequence, and append them to a list."""
        metered = (
            executor.metered(jobs)
            if isinstance(executor, Batch)
            else metering_ahead(self._worker(sink), self.execution).jobs(jobs)
        )
        for job in metered:
            frames.append(job)
            yield job

    def _wait(self, change: int) -> None:
        self.summary.waiting += change
        self.watch()

    def _worker(self, sink: Folder) -> ImageWorker:
        """Return what does the work of each image."""
        return ImageWorker(self._loader, sink, self._chain, self.execution.trace is not None)

    def _log_outcomes(
        self, running: Iterable[Outcome], log: RunLog, trace: Trace | None
    ) -> Iterator[Outcome]:
        """Count and log outcomes, and yield them.

        Raises:
            OutputError: the log cannot be written. Images in flight are finished first.
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
                        self._halt()
                limit = self.execution.max_failures
                if limit and self.summary.exceeds(limit.count(self.summary.total)):
                    self._halt()
                if trace:
                    trace.add(outcome)
                yield outcome
            if unlogged:
                raise unlogged
        finally:
            self.summary.interrupted = self.summary.finished < self.summary.total
            if not unlogged:
                log.end(self.summary)

    def _finish_folders(self, folders: Sequence[Path]) -> None:
        """Write the camera files of a run's directories, and add notes."""
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
                f"{count} {pictures} in {self.execution.output} {are} of inputs that no longer "
                "exist"
            )

    def missing(self) -> list[Job]:
        """Return the jobs of which pictures are missing, without writing anything.

        Raises:
            RequestError, OutputError: the output directory cannot be used or read.
        """
        sink = self.sink()
        if isinstance(sink, RemoteTars):
            return [job for tar in sink.tars if not sink.has(tar) for job in tar.jobs]
        worker = self._worker(sink)
        return [job for job in self.jobs if not worker.is_done(job)]

    def trial(self, jobs: Sequence[Job], folder: Path) -> "Run":
        """Return a run of some of the jobs on this machine, which writes files to a directory."""
        options = {"output": folder, "redo": Redo.ALL, "trace": None, "max_failures": None}
        execution = replace(self.execution, **options)  # type: ignore[arg-type]
        return Run(self._loader.request, Images(known_jobs=jobs), execution)

    def sink(self) -> Folder:
        """Return the sink of the pictures: the output directory, clips or tars in it, or a URL.

        Raises:
            RequestError: clpipe did not write the tars at the URL, or two clips have one name.
        """
        execution = self.execution
        if self.images.clips:
            return Clips(self.writer, execution.redo, self.jobs, self.images.clips)
        if not self._tars:
            return Folder(self.writer, execution.redo)
        kind = RemoteTars if url_of(execution.output) else Tars
        return kind(self.writer, execution.redo, self._tars)

    def _executor(self, sink: Folder, jobs: Iterable[Job]) -> AbstractContextManager[Executor]:
        """Return the executor: threads or processes of this machine, or a cluster.

        Raises:
            RequestError: the cluster cannot be used.
            DeviceError: there is no usable device.
        """
        execution = self.execution
        if self._dask is not None:
            from clpipe.batch.dask_client import connected
            from clpipe.batch.dask_worker import DaskSpec

            return connected(self._dask, DaskSpec(self._request, execution, self.jobs[0]))
        # All images are assumed to have the size of the first one, because reading every header
        # takes time.
        claim = self._loader.claim(self.jobs[0])
        if not sink.allows_processes:
            count = 1
        elif execution.processes:
            count = execution.processes
        elif self.images.sequence or jobs is not self.jobs:
            count = 1  # frames are metered in order; the length of a lazy iterable is unknown
        else:
            count = default_processes(len(self.jobs), claim, available_processors())
        if count > 1:
            spec = RunSpec(self._request, execution, self.jobs[0])
            return nullcontext(Processes(spec, count, claim))
        devices: list[Device | None] = [*open_devices(execution.devices, execution.memory)] or [
            None
        ]
        if self.images.sequence and has_state(self._chain):
            del devices[1:]
        return nullcontext(Batch(self._worker(sink), devices, execution.threads))
