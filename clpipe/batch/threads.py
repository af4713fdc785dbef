"""Many images through devices: threads that decode, develop and encode, a few images in flight.

An image is decoded, then each picture of it is made by a device's thread and written by another.
A job is let in only when one before it has left, so memory does not grow with their number.
"""

import os
import queue
import threading
from collections import deque
from collections.abc import Callable, Generator, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager
from dataclasses import replace
from functools import cached_property
from typing import Any

import numpy as np

from clpipe.base.errors import ImageError, OutputError, RequestError
from clpipe.batch.outcome import LEFT_OUT, SKIPPED, Outcome, Span
from clpipe.batch.work import Made, Work, _Spare
from clpipe.chain.chain import Chain
from clpipe.engine.device import Device, Timing
from clpipe.engine.runner import Result, Runner
from clpipe.images.openimageio import set_codec_threads
from clpipe.inputs.find import Job
from clpipe.inputs.loader import ImageLoader
from clpipe.outputs.formats import DNG, SIDECAR
from clpipe.outputs.renditions import Rendition
from clpipe.outputs.sidecar import check_own, is_done, sidecar, stamp_of, wanted, write_sidecar
from clpipe.outputs.writer import OutputWriter
from clpipe.stage import Kind


class Batch:
    """A run over many images.

    Args:
        entrance: what is asked for, and how files are read.
        target: where the pictures go.
        devices: where to develop, a thread for each; [None] is NumPy.
        chain: that of the first image, for which kernels are compiled while it is decoded.
        threads: how many decode, and how many encode; None is one for each processor.
        overwrite: make what is there already, too.
        trace: note each launch and transfer.
    """

    def __init__(
        self,
        entrance: ImageLoader,
        target: OutputWriter,
        devices: Sequence[Device | None],
        chain: Chain,
        threads: int | None = None,
        overwrite: bool = False,
        trace: bool = False,
    ) -> None:
        self.devices = list(devices)
        self.threads = threads or len(os.sched_getaffinity(0))
        self.in_flight = self.threads + len(self.devices) + 1
        self._entrance = entrance
        self._target = target
        self._chain = chain
        self._overwrite = overwrite
        self._trace = trace
        self._spare = _Spare(self.threads + len(self.devices))
        self._stopping = threading.Event()

    @property
    def stopping(self) -> bool:
        """Whether no more images are let in."""
        return self._stopping.is_set()

    def stop(self) -> None:
        """Let no more images in; those in flight are finished."""
        self._stopping.set()

    def run(self, jobs: Sequence[Job]) -> Generator[Outcome, None, None]:
        """Put every job through; one that fails is reported and the others go on.

        Outcomes come as jobs are finished, in any order.

        Raises:
            OutputError: nothing can be written any more. What was in flight is reported before.
            DeviceError: a kernel does not compile.
        """
        processors = len(os.sched_getaffinity(0))
        set_codec_threads(max(processors // min(self.threads, max(len(jobs), 1)), 1))
        run = _Run(self, jobs)
        try:
            yield from run.outcomes()
        finally:
            run.close()

    def one_by_one(
        self, jobs: Sequence[Job], on: Callable[[str], AbstractContextManager[None]]
    ) -> Iterator[Outcome]:
        """The same in this thread alone: what a run is measured against.

        ``on`` is entered around each step of each image.
        """
        (device,) = self.devices
        runners = self.runners(device)
        for job in jobs:
            with on("decode"):
                work = self.decode(job, lambda: None)
            for shot in work.shots:
                with on("device"):
                    result = self.develop(work, shot, runners(shot))
                if result:
                    with on("encode"):
                        self.encode(work, shot, result, device)
            yield work.outcome()

    def runners(self, device: Device | None) -> Callable[[Rendition], Runner]:
        """What makes the runner of a shot on a device; the kernels of the first are compiled."""
        entrance, target = self._entrance, self._target
        first = target.runner(Rendition("", self._chain, ""), device)
        try:
            first.warm_up(half=entrance.reentry is None and self._chain.source is Kind.RGB)
        except ImageError as error:  # not even one of 8x8 pixels
            raise RequestError(f"--memory: too little for any image: {error}") from None
        latest = [(self._chain, first)]
        alike = {(first.keep, first.encode, first.final): first}

        def runner(shot: Rendition) -> Runner:
            for known, its in latest:
                if known is shot.chain:
                    return its
            made = target.runner(shot, device)
            base = alike.setdefault((made.keep, made.encode, made.final), made)
            if base is not made:
                made = base.of(shot.chain)  # with the plans that are there
            latest.insert(1, (shot.chain, made))
            del latest[4:]
            return made

        return runner

    def decode(self, job: Job, begin: Callable[[], None]) -> Work:
        """A job's image and what to make of it, without what is there already.

        ``begin`` is called where anything is to be made.
        """
        work = Work(job, self._entrance)
        with work.timed("decode"):
            try:
                work.entrance = self._entrance.of(job)
                work.wanted = {**self._wanted_of(work.entrance), "image_key": job.key}
                names = self._missing(work)
                if names:
                    begin()
                    self._read(work, names)
                else:
                    work.status = SKIPPED
            except (ImageError, RequestError, MemoryError) as error:
                if work.entrance.is_left_out(job, error):
                    work.status = LEFT_OUT
                else:
                    work.error = work.entrance.explain(job, error)
        return work

    def _wanted_of(self, entrance: ImageLoader) -> Mapping[str, Any]:
        if entrance is self._entrance:
            return self._wanted
        return wanted(entrance.asked, entrance.reading, self._target)

    @cached_property
    def _wanted(self) -> Mapping[str, Any]:
        return wanted(self._entrance.asked, self._entrance.reading, self._target)

    def _missing(self, work: Work) -> list[str]:
        """The names of the pictures that are to be made, which are not there already."""
        names = self._target.pictures_of(work.job)
        if self._overwrite:
            return list(names)
        return [name for name in names if not self.is_there(work.job, name, work.wanted)]

    def is_there(self, job: Job, name: str, wanted: Mapping[str, Any]) -> bool:
        """Whether a picture is there already, as it is wanted.

        Raises:
            ImageError: a file of its name is somebody else's.
        """
        target = self._target
        path, outputs = target.path(job, SIDECAR, name), target.outputs(job, name)
        if is_done(path, job, wanted, outputs):
            return True
        if not path.exists():
            for output in outputs:
                check_own(output)
        return False

    def _read(self, work: Work, names: Sequence[str]) -> None:
        """Read a job's image, and see what pictures are to be made of it.

        Raises:
            ImageError, RequestError, MemoryError: it cannot be read, or cannot enter.
        """
        job = work.job
        work.stamp = stamp_of(job.path)
        source = work.entrance.read(job)
        self._target.check_size(source)
        entered = work.entrance.enter(job, source)
        if entered is None:
            work.status = LEFT_OUT
            return
        work.source = entered.source
        shots = self._target.burst_of(job).shots(entered.chain, entered.key)
        work.shots = [shot for shot in shots if shot.name in names]
        work.unwritten = len(work.shots)

    def develop(self, work: Work, shot: Rendition, runner: Runner) -> Result | None:
        """One picture; None where it cannot be made."""
        assert work.source
        timings: list[Timing] | None = [] if self._trace and runner.device else None
        with work.timed("device"):
            try:
                pixels = work.source.pixels
                into = self._spare.take(pixels.shape) if runner.encode and runner.device else None
                result = runner.run(pixels, shot.key, timings, into=into)
            except (ImageError, RequestError, MemoryError) as error:
                work.error = work.entrance.explain(work.job, error)
                return None
        name = threading.current_thread().name
        work.spans += [Span(t.name, name, t.start, t.seconds) for t in timings or []]
        if shot is work.shots[-1] and DNG not in self._target.formats:
            # From here on only its shape is wanted.
            shape = work.source.pixels.shape
            work.source = replace(work.source, pixels=np.broadcast_to(np.float16(0), shape))
        return result

    def encode(self, work: Work, shot: Rendition, result: Result, device: Device | None) -> None:
        """Write one picture and then its sidecar.

        Raises:
            OutputError: nothing can be written any more.
        """
        target = self._target
        assert work.source
        with work.timed("encode"):
            try:
                files = target.write(work.job, shot, work.source, result)
                path = target.path(work.job, SIDECAR, shot.name)
                names = [file.name for file in files]
                frames = target.burst_of(work.job).frames
                record = sidecar(
                    work.job, work.stamp, shot, frames, device, work.source, result, names
                )
                write_sidecar(path, {**record, "asked": work.wanted})
                work.outputs += [str(f.relative_to(target.folder)) for f in (*files, path)]
            except (ImageError, MemoryError) as error:
                target.check_folder()
                work.error = work.entrance.explain(work.job, error)
        if result.encoded is not None and device:
            self._spare.give(result.encoded)


class _Run:
    """The threads of one run, and what passes between them."""

    def __init__(self, batch: Batch, jobs: Sequence[Job]) -> None:
        self._batch = batch
        self._todo = deque(jobs)
        self._admitted = 0
        self._failure: Exception | None = None
        self._broken = self._closing = False
        self._begun = threading.Event()
        self._lock = threading.Lock()
        self._places = threading.Semaphore(batch.in_flight)
        self._results = threading.Semaphore(batch.threads + len(batch.devices))
        self._decoded: queue.SimpleQueue[Work | None] = queue.SimpleQueue()
        self._made: queue.SimpleQueue[Made | None] = queue.SimpleQueue()
        self._news: queue.SimpleQueue[Outcome | None] = queue.SimpleQueue()
        self._decoders = [self._thread(f"decode {i}", self._decoding) for i in range(batch.threads)]
        self._developers = [
            self._thread(f"device {i}", self._developing, device)
            for i, device in enumerate(batch.devices)
        ]
        self._encoders = [self._thread(f"encode {i}", self._encoding) for i in range(batch.threads)]

    def _thread(self, name: str, work: Callable[..., None], *arguments: Any) -> threading.Thread:
        """A thread; what it cannot handle ends the run."""

        def guarded() -> None:
            try:
                work(*arguments)
            except Exception as error:
                self._fail(error)
                self._broken = True
                self._news.put(None)

        thread = threading.Thread(target=guarded, name=name, daemon=True)
        thread.start()
        return thread

    def _fail(self, error: Exception) -> None:
        """Let nothing more in, and remember why."""
        self._failure = self._failure or error
        self._batch.stop()

    def outcomes(self) -> Iterator[Outcome]:
        """Each job's outcome, as they come, until no job is in flight and none is to come."""
        finished = ended = 0
        while not self._broken and (ended < len(self._decoders) or finished < self._admitted):
            news = self._news.get()
            if news is None:
                ended += 1
                continue
            finished += 1
            self._places.release()
            yield news
        if self._failure:
            raise self._failure

    def close(self) -> None:
        """Let the threads end, also those that wait."""
        self._batch.stop()
        self._closing = True
        self._begun.set()
        for _ in self._decoders:
            self._places.release()
        for _ in self._developers:
            self._decoded.put(None)
            if self._broken:
                self._results.release()  # perhaps nobody is left to do so
        for thread in [*self._decoders, *self._developers]:
            thread.join()
        for _ in self._encoders:
            self._made.put(None)
        for thread in self._encoders:
            thread.join()

    def _next(self) -> Job | None:
        """The next job to let in, once there is a place for it; None where none is to come."""
        self._places.acquire()
        with self._lock:
            if not self._todo or self._batch.stopping:
                return None
            self._admitted += 1
            return self._todo.popleft()

    def _decoding(self) -> None:
        while job := self._next():
            work = self._batch.decode(job, self._begun.set)
            if work.shots:
                self._decoded.put(work)
            else:
                self._news.put(work.outcome())
            del work
        self._places.release()  # for the next thread, which has nothing to do either
        self._news.put(None)

    def _developing(self, device: Device | None) -> None:
        self._begun.wait()  # where nothing is to be made, nothing is compiled
        if self._closing:
            return
        runners = self._batch.runners(device)
        while work := self._decoded.get():
            for shot in work.shots:
                self._results.acquire()
                if self._broken:
                    return
                result = None
                if not work.error:
                    result = self._batch.develop(work, shot, runners(shot))
                if result:
                    self._made.put((work, shot, result, device))
                else:
                    self._written(work)
                del result
            del work, shot

    def _encoding(self) -> None:
        while made := self._made.get():
            try:
                self._batch.encode(*made)
            except OutputError as error:
                made[0].error = f"{made[0].job.path}: {error}"
                self._fail(error)
            self._written(made[0])
            del made

    def _written(self, work: Work) -> None:
        """One picture less to wait for; with its last one a job is finished."""
        self._results.release()
        with self._lock:
            work.unwritten -= 1
            finished = work.unwritten == 0
        if finished:
            self._news.put(work.outcome())
