"""Many images at once: threads that decode, develop and encode, with a few images in flight.

An image is decoded by one thread, each rendition of it is developed by a device's thread and
encoded by another one. A job is let in only when one before it has left, so memory does not grow
with the number of jobs.
"""

import os
import queue
import threading
from collections import deque
from collections.abc import Callable, Generator, Iterator, Sequence
from typing import Any

from clpipe.base.errors import OutputError
from clpipe.batch.outcome import Outcome
from clpipe.batch.work import ImageWorker, Task
from clpipe.engine.device import Device
from clpipe.engine.runner import Result
from clpipe.images.openimageio import set_codec_threads
from clpipe.inputs.find import Job
from clpipe.outputs.renditions import Rendition

# A rendition between a device and its files.
Developed = tuple[Task, Rendition, Result, Device | None]


class Batch:
    """One run over many images.

    Args:
        worker: what is done to each image.
        devices: where to develop, a thread for each; [None] is NumPy.
        threads: how many decode, and how many encode; None is one for each processor.
    """

    def __init__(
        self, worker: ImageWorker, devices: Sequence[Device | None], threads: int | None = None
    ) -> None:
        self.devices = list(devices)
        self.threads = threads or len(os.sched_getaffinity(0))
        self.in_flight = self.threads + len(self.devices) + 1
        self._worker = worker
        worker.reserve(self.threads + len(self.devices))
        self._waiting: deque[Job] = deque()
        self._admitted = 0
        self._failure: Exception | None = None
        self._stopping = threading.Event()
        self._broken = self._closing = False
        self._begun = threading.Event()  # there is something to develop
        self._lock = threading.Lock()
        self._places = threading.Semaphore(self.in_flight)
        self._results = threading.Semaphore(self.threads + len(self.devices))
        self._decoded: queue.SimpleQueue[Task | None] = queue.SimpleQueue()
        self._developed: queue.SimpleQueue[Developed | None] = queue.SimpleQueue()
        # None: a thread that decodes has ended, or one of any kind has failed.
        self._outcomes: queue.SimpleQueue[Outcome | None] = queue.SimpleQueue()

    def stop(self) -> None:
        """Let no more images in; those in flight are finished."""
        self._stopping.set()

    def run(self, jobs: Sequence[Job]) -> Generator[Outcome, None, None]:
        """Do every job; one that fails is reported and the others go on. A batch runs once.

        Outcomes come as jobs are finished, in any order.

        Raises:
            OutputError: nothing can be written any more. What was in flight is reported before.
            DeviceError: a kernel does not compile.
        """
        processors = len(os.sched_getaffinity(0))
        set_codec_threads(max(processors // min(self.threads, max(len(jobs), 1)), 1))
        self._waiting.extend(jobs)
        numbers = range(self.threads)
        decoders = [self._start(f"decode {i}", self._decode_all) for i in numbers]
        developers = [
            self._start(f"device {i}", self._develop_all, device)
            for i, device in enumerate(self.devices)
        ]
        encoders = [self._start(f"encode {i}", self._encode_all) for i in numbers]
        try:
            yield from self._finished(len(decoders))
        finally:
            self._close(decoders, developers, encoders)

    def _start(self, name: str, work: Callable[..., None], *arguments: Any) -> threading.Thread:
        """Start a thread. An error that it does not handle ends the run."""

        def guarded() -> None:
            try:
                work(*arguments)
            except Exception as error:
                self._fail(error)
                self._broken = True
                self._outcomes.put(None)

        thread = threading.Thread(target=guarded, name=name, daemon=True)
        thread.start()
        return thread

    def _fail(self, error: Exception) -> None:
        """Let nothing more in, and remember the first error."""
        self._failure = self._failure or error
        self.stop()

    def _finished(self, decoders: int) -> Iterator[Outcome]:
        """Each job's outcome, until no job is in flight and none is to come."""
        finished = ended = 0
        while not self._broken and (ended < decoders or finished < self._admitted):
            outcome = self._outcomes.get()
            if outcome is None:
                ended += 1
                continue
            finished += 1
            self._places.release()
            yield outcome
        if self._failure:
            raise self._failure

    def _close(
        self,
        decoders: Sequence[threading.Thread],
        developers: Sequence[threading.Thread],
        encoders: Sequence[threading.Thread],
    ) -> None:
        """Let all threads end, also those that wait."""
        self.stop()
        self._closing = True
        self._begun.set()
        for _ in decoders:
            self._places.release()
        for _ in developers:
            self._decoded.put(None)
            if self._broken:
                self._results.release()  # perhaps nobody is left to do so
        for thread in (*decoders, *developers):
            thread.join()
        for _ in encoders:
            self._developed.put(None)
        for thread in encoders:
            thread.join()

    def _next(self) -> Job | None:
        """The next job, once there is a place for it; None where none is to come."""
        self._places.acquire()
        with self._lock:
            if not self._waiting or self._stopping.is_set():
                return None
            self._admitted += 1
            return self._waiting.popleft()

    def _decode_all(self) -> None:
        while job := self._next():
            task = self._worker.decode(job, self._begun.set)
            if task.renditions:
                self._decoded.put(task)
            else:
                self._outcomes.put(task.outcome())
            del task
        self._places.release()  # for the next thread, which has no job to wait for either
        self._outcomes.put(None)

    def _develop_all(self, device: Device | None) -> None:
        self._begun.wait()  # a run that makes nothing compiles nothing
        if self._closing:
            return
        runners = self._worker.runners(device)
        while task := self._decoded.get():
            for rendition in task.renditions:
                self._results.acquire()
                if self._broken:
                    return
                result = None
                if not task.error:
                    result = self._worker.develop(task, rendition, runners.of(rendition))
                if result:
                    self._developed.put((task, rendition, result, device))
                else:
                    self._count_written(task)
                del result
            del task, rendition

    def _encode_all(self) -> None:
        while developed := self._developed.get():
            task = developed[0]
            try:
                self._worker.encode(*developed)
            except OutputError as error:
                task.error = f"{task.job.path}: {error}"
                self._fail(error)
            self._count_written(task)
            del developed, task

    def _count_written(self, task: Task) -> None:
        """One rendition less to wait for; with the last one the job is finished."""
        self._results.release()
        with self._lock:
            task.unwritten -= 1
            is_finished = task.unwritten == 0
        if is_finished:
            self._outcomes.put(task.outcome())
