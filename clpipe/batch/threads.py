"""Many images at once: threads that each make one image, or a few small ones, from file to file.

Such a thread decodes, asks a device's thread for each rendition, and has a pool encode it. There is
a fixed number of them, and an image is let in only when it fits into the memory beside the others,
so memory does not grow with the number of jobs. With one of them, all is done in turn, which a
process that has one processor needs: threads that run at the same time take turns at the
interpreter's lock some fifty times an image, which of a small image's time is a third.
"""

import queue
import threading
import time
from collections.abc import Callable, Generator, Iterable, Sequence, Sized
from contextlib import suppress
from dataclasses import replace
from functools import partial

from clpipe.base.cpu_time import CpuTimer
from clpipe.base.errors import OutputError, RequestError
from clpipe.base.processors import available_processors
from clpipe.batch.developing import TOGETHER, Developers, depth_of
from clpipe.batch.job_state import JobState, failure_text
from clpipe.batch.outcome import Outcome
from clpipe.batch.room import Room, usual_room
from clpipe.batch.work import ImageWorker, Written
from clpipe.engine.device import Device
from clpipe.images.openimageio import set_codec_threads
from clpipe.inputs.find import Job

Jobs = queue.SimpleQueue[Job | Exception | None]  # None: there are no more; an error ends the run

Made = tuple[JobState, list[Written]]  # a job, and its renditions, which have no names yet

COMMITTED = 64  # images at a time at most; more would make those that wait for them late


class Batch:
    """One run over many images.

    Args:
        worker: what is done to each image.
        devices: where to develop, a thread for each; [None] is NumPy.
        threads: how many decode, and how many encode, at a time; None is one for each processor.
        room: bytes that images in flight may take; None is :func:`~clpipe.batch.room.usual_room`.
        in_flight: how many threads make images; None is enough to keep all others busy. One does
            small images a few at a time.
        compiled: is called when a device has its kernels.
    """

    def __init__(
        self,
        worker: ImageWorker,
        devices: Sequence[Device | None],
        threads: int | None = None,
        room: int | None = None,
        in_flight: int | None = None,
        compiled: Callable[[], None] = lambda: None,
    ) -> None:
        self.devices = list(devices)
        self.threads = threads or available_processors()
        results = self.threads + sum(map(depth_of, self.devices))  # at a time
        self.in_flight = in_flight or results + 1
        self._worker = worker
        worker.reserve(results)
        size = usual_room() if room is None else room
        self._room = Room(size, self.devices, partial(worker.reserve, results))
        self._failure: Exception | None = None
        self._stopping = threading.Event()
        self._decoding = threading.Semaphore(self.threads)  # limits the threads that decode
        self._developers = Developers(
            worker, self.devices, self.threads, self._room, compiled, self._fail
        )
        self._jobs: Jobs = queue.SimpleQueue()
        # None: a thread has ended.
        self._made: queue.Queue[Made | None] = queue.Queue(COMMITTED)
        self._outcomes: queue.Queue[Outcome | None] = queue.Queue(COMMITTED)

    def stop(self) -> None:
        """Let no more images in; those in flight are finished. May be called by a signal."""
        self._stopping.set()
        self._jobs.put(None)  # for one that waits

    @property
    def is_stopping(self) -> bool:
        """Whether no more images are let in."""
        return self._stopping.is_set()

    def run(self, jobs: Iterable[Job] | Jobs) -> Generator[Outcome, None, None]:
        """Do every job; one that fails is reported and the others go on. A batch runs once.

        Outcomes come as jobs are finished, in any order.

        Args:
            jobs: the images; what is no sequence may take its time, and what it raises ends the
                run.

        Raises:
            OutputError: nothing can be written any more. What was in flight is reported before.
            DeviceError: on no device is work possible any more. Where some can still be used, the
                others' work is theirs.
        """
        developers = self._developers
        count = max(len(jobs), 1) if isinstance(jobs, Sized) else self.in_flight
        codecs = max(available_processors() // min(self.threads, count), 1)
        set_codec_threads(codecs)
        self.in_flight = min(self.in_flight, count)
        if isinstance(jobs, queue.SimpleQueue):
            self._jobs = jobs
        elif isinstance(jobs, Sized):
            self._queue(jobs)
        else:
            self._start("jobs", self._queue, jobs)
        if self.is_stopping:
            self.stop()
        committer = self._start("write", self._commit_all)
        threads: list[threading.Thread] = []
        makers, is_over = 0, False
        try:
            for number, device in enumerate(self.devices):
                threads.append(self._start(f"device {number}", developers.develop_all, device))
            for makers in range(1, self.in_flight + 1):
                threads.append(self._start(f"image {makers - 1}", self._make_all))
            while (outcome := self._outcomes.get()) is not None:
                yield outcome
            is_over = True
        finally:
            self.stop()
            self._room.open()
            for _ in range(self.in_flight - makers):  # that could not be started
                self._made.put(None)
            while not is_over and self._outcomes.get() is not None:
                pass
            developers.close()
            for thread in (committer, *threads):
                thread.join()
        if self._failure:
            raise self._failure

    def _start(self, name: str, work: Callable[..., None], *arguments: object) -> threading.Thread:
        """Start a thread."""

        def timed() -> None:
            with CpuTimer("Python"):
                work(*arguments)

        thread = threading.Thread(target=timed, name=name, daemon=True)
        try:
            thread.start()
        except RuntimeError:  # the system gives no more, or their stacks do not fit
            raise RequestError(
                f"--jobs: {self.threads}: no thread can be started for '{name}'; ask for fewer, or "
                "allow more threads (ulimit -u) or memory (ulimit -v)"
            ) from None
        return thread

    def _queue(self, jobs: Iterable[Job]) -> None:
        """Queue all jobs, while more are let in."""
        try:
            for job in jobs:
                if self.is_stopping:
                    break
                self._jobs.put(job)
        except Exception as error:
            self._jobs.put(error)
        self._jobs.put(None)

    def _fail(self, error: BaseException) -> None:
        """Let nothing more in, and remember the first error."""
        known = error if isinstance(error, Exception) else RuntimeError(repr(error))
        self._failure = self._failure or known
        self.stop()

    def _next(self, is_waiting: bool) -> Job | None:
        """The next job; None where none is to come, or none is there and nothing is to wait."""
        try:
            job = self._jobs.get(is_waiting)
        except queue.Empty:
            return None
        if isinstance(job, Exception):
            self._fail(job)
        if isinstance(job, Job) and not self.is_stopping:
            return job
        self._jobs.put(None)  # for the others
        return None

    def _make_all(self) -> None:
        """Make images until none is to come."""
        decoded: list[JobState] = []
        most = TOGETHER if self.in_flight == 1 else 1
        try:
            while True:
                with self._decoding:  # also while it waits for a job, so they are begun in order
                    if job := self._next(not decoded):
                        decoded.append(self._decoded(job, decoded))
                if not decoded:
                    break
                if not job or len(decoded) >= most or not self._developers.is_small(decoded[-1]):
                    self._make(decoded)
        except BaseException as error:  # behind an image's back
            self._fail(error)
            self._room.open()
        finally:
            self._made.put(None)

    def _decoded(self, job: Job, beside: list[JobState]) -> JobState:
        """A job whose image is decoded; ``beside`` is what this thread has decoded before."""
        state = JobState(job, self._worker.loader)
        waits: list[float] = []
        try:
            state = self._worker.decode(job, partial(self._admit, beside, waits))
        except OutputError as error:
            state.error = failure_text(job, error)
            self._fail(error)
        except BaseException as error:  # nothing that one image does may end a thread
            state.error = failure_text(job, error)
        state.spans = [  # without the wait for room, which is no decoding
            replace(span, start=span.start + sum(waits), seconds=span.seconds - sum(waits))
            for span in state.spans
        ]
        return state

    def _admit(self, beside: list[JobState], waits: list[float], job: Job) -> None:
        """Wait until there is room for a job's image, and note how long: it is decoded next.

        Raises:
            OutputError: the first image of the run is to be made, but cannot be written.
            ImageError: there is none.
        """
        worker, developers = self._worker, self._developers
        if not developers.is_needed:
            worker.writer.check_folder()
        developers.begin()
        size = worker.bytes_of(job, developers.most, None in self.devices)
        start = time.perf_counter()
        if beside and not self._room.fits(size):
            self._make(beside)  # and give their memory back
        self._room.enter(job.stem, size)
        waits.append(time.perf_counter() - start)

    def _make(self, decoded: list[JobState]) -> None:
        """Have the renditions of jobs made, and let go of the jobs.

        Raises:
            DeviceError, RequestError: no device is left to make them.
        """
        failure: Exception | None = None
        for state, orders in zip(decoded, self._developers.order(decoded), strict=True):
            state.drop_pixels()
            self._room.leave(state.job.stem)
            try:
                results = [order.written.result() for order in orders]
            except Exception as error:
                failure = error
                for order in orders:
                    order.discard()
            else:
                self._made.put((state, [written for written in results if written]))
        decoded.clear()
        if failure:
            raise failure

    def _commit_all(self) -> None:
        """Bring to the disk, together, what was made while the disk had what was made before."""
        ended = 0
        try:
            while ended < self.in_flight:
                taken = [self._made.get()]
                with suppress(queue.Empty):
                    while len(taken) < COMMITTED:
                        taken.append(self._made.get_nowait())
                made = [each for each in taken if each]
                ended += taken.count(None)
                self._commit(made)
                for state, _ in made:
                    self._outcomes.put(state.outcome())
        except BaseException as error:  # behind an image's back
            self._fail(error)
            while ended < self.in_flight:
                if left := self._made.get():
                    for written in left[1]:
                        written.group.discard()
                else:
                    ended += 1
        finally:
            self._outcomes.put(None)

    def _commit(self, made: Sequence[Made]) -> None:
        """Bring the renditions of jobs to the disk, and give them their names."""
        try:
            self._worker.commit([(state, each) for state, files in made for each in files])
        except OutputError as error:
            self._fail(error)
        except BaseException as error:
            for state, _ in made:
                state.error = failure_text(state.job, error)
