"""The threads of one process: each makes one image at a time, or a few small ones.

Such a thread decodes an image, orders its renditions from :mod:`clpipe.batch.developing`, and waits
for them. Their number is fixed, and an image starts only if it fits into memory together with those
in flight. So memory does not grow with the number of jobs.

With a single thread, all steps run one after the other. A process that has one processor needs
this: threads that run at the same time exchange the interpreter's lock about fifty times for each
image, which takes a third of a small image's time.
"""

import queue
import threading
import time
from collections.abc import Callable, Generator, Iterable, Iterator, Sequence, Sized
from contextlib import contextmanager, suppress
from dataclasses import replace
from functools import partial

from clpipe.base.cpu_time import CpuTimer
from clpipe.base.errors import ImageError, OutputError, RequestError
from clpipe.base.processors import available_processors
from clpipe.batch.developing import Developing, discard
from clpipe.batch.downloads import Downloads, Jobs
from clpipe.batch.frames import Turns
from clpipe.batch.job_state import DecodedFrame, JobState, Written
from clpipe.batch.memory_budget import Lease, MemoryBudget, default_budget
from clpipe.batch.metering import Metering
from clpipe.batch.outcome import Outcome
from clpipe.batch.work import ImageWorker
from clpipe.engine.device import Device
from clpipe.engine.service import MAX_STACK, depth_of
from clpipe.images.openimageio import set_codec_threads
from clpipe.inputs.find import Job

Made = tuple[JobState, list[Written]]  # a job, and its renditions under temporary names

MAX_COMMIT = 64  # images that are synchronised to the disk at a time


class Batch:
    """One run over many images.

    Args:
        worker: does the work of each image.
        devices: the devices that develop, each with its own thread; [None] is NumPy.
        threads: the number of images that are decoded at a time, and of those that are encoded.
            None is one for each processor.
        memory: bytes that images in flight may take. None is
            :func:`~clpipe.batch.memory_budget.default_budget`.
        in_flight: the number of threads that make images. None is enough to keep all others busy.
            A single thread takes several small images at a time.
    """

    def __init__(
        self,
        worker: ImageWorker,
        devices: Sequence[Device | None],
        threads: int | None = None,
        memory: int | None = None,
        in_flight: int | None = None,
    ) -> None:
        self.devices = list(devices)
        self.threads = threads or available_processors()
        results = self.threads + sum(map(depth_of, self.devices))  # results that exist at a time
        self.in_flight = in_flight or results + 1
        self._worker = worker
        worker.reserve(results)
        size = default_budget() if memory is None else memory
        self._budget = MemoryBudget(size, self.devices, partial(worker.reserve, results))
        self._is_checked = False  # whether the output directory can be written to
        self._failure: Exception | None = None
        self._stopping = threading.Event()
        self._decoding = threading.Semaphore(self.threads)  # limits the threads that decode
        self._renditions = Developing(worker, self.devices, self.threads, self._budget, self._fail)
        develop = self._renditions.service.run
        self._metering = Metering(worker, self._acquire_for_metering, develop)
        self._jobs: Jobs = queue.SimpleQueue()
        self._downloads = Downloads(self._begin)
        # Frames of sequences get memory, and then their device, in the order of the jobs.
        self._admitting, self._developing = self._turns = Turns(), Turns()
        # None means that one of the threads has ended.
        self._made: queue.Queue[Made | None] = queue.Queue(MAX_COMMIT)
        self._outcomes: queue.Queue[Outcome | None] = queue.Queue(MAX_COMMIT)

    def stop(self) -> None:
        """Begin no more images, and finish those in flight. A signal handler may call it."""
        self._stopping.set()
        self._jobs.put(None)  # for a thread that waits

    @property
    def is_stopping(self) -> bool:
        """Whether no more images are begun."""
        return self._stopping.is_set()

    def metered(self, jobs: Iterable[Job]) -> Iterator[Job]:
        """Yield frames of sequences with the settings of their sequence, for :meth:`run`.

        Frames are metered with the devices and the memory of this run, and decoded once.
        """
        return self._metering.jobs(jobs)

    def run(self, jobs: Iterable[Job]) -> Generator[Outcome, None, None]:
        """Do every job, and yield outcomes as jobs finish, in any order. A batch runs once.

        Args:
            jobs: the images. A lazy iterable is advanced by a thread of its own, so it may block;
                an error that it raises ends the run.

        Raises:
            OutputError: nothing more can be written. The outcomes of images in flight come first.
            DeviceError: no device is usable any more. If one fails, the others take over its work.
        """
        count = max(len(jobs), 1) if isinstance(jobs, Sized) else self.in_flight
        codecs = max(available_processors() // min(self.threads, count), 1)
        set_codec_threads(codecs)
        self.in_flight = min(self.in_flight, count)
        if isinstance(jobs, Sized):
            self._queue(jobs)
        else:
            self._start("jobs", self._queue, jobs)
        if self.is_stopping:
            self.stop()
        committer = self._start("write", self._commit_all)
        threads: list[threading.Thread] = []
        started, is_over = 0, False
        try:
            for started in range(1, self.in_flight + 1):
                threads.append(self._start(f"image {started - 1}", self._make_all))
            while (outcome := self._outcomes.get()) is not None:
                yield outcome
            is_over = True
        finally:
            self.stop()
            self._budget.close()
            self._admitting.close()
            self._metering.close()
            for _ in range(self.in_flight - started):  # for threads that could not be started
                self._made.put(None)
            while not is_over and self._outcomes.get() is not None:
                pass
            self._renditions.close()
            for thread in (committer, *threads):
                thread.join()
            self._downloads.close()
        if self._failure:
            raise self._failure

    def _start(self, name: str, work: Callable[..., None], *arguments: object) -> threading.Thread:
        """Start a thread."""

        def timed() -> None:
            with CpuTimer("Python"):
                work(*arguments)

        thread = threading.Thread(target=timed, name=name, daemon=True)
        with self._starting(name):
            thread.start()
        return thread

    @contextmanager
    def _starting(self, name: str) -> Iterator[None]:
        """Explain the error if the system allows no more threads, or has no memory for one."""
        try:
            yield
        except RuntimeError:
            raise RequestError(
                f"--jobs: {self.threads}: no thread can be started for '{name}'; ask for fewer, or "
                "allow more threads (ulimit -u) or memory (ulimit -v)"
            ) from None

    def _begin_devices(self) -> None:
        """Let the devices compile their kernels, if they have not begun.

        Raises:
            RequestError: the system allows no more threads.
        """
        try:
            with self._starting("device"):
                self._renditions.begin()
        except RequestError as error:  # of the run, not of one image
            self._fail(error)
            raise

    def _queue(self, jobs: Iterable[Job]) -> None:
        """Queue all jobs, until the run stops."""
        try:
            for job in self._worker.frames.whole_sequences(jobs):
                if self.is_stopping:
                    break
                for turns in self._turns:
                    turns.expect(job)
                if job.place and self._metering.queue(job, self._admitting.is_first(job)):
                    self._admitting.end(job)
                self._jobs.put(job)
        except Exception as error:
            self._jobs.put(error)
        self._jobs.put(None)

    def _fail(self, error: BaseException) -> None:
        """Stop the run, and remember the first error."""
        exception = error if isinstance(error, Exception) else RuntimeError(repr(error))
        self._failure = self._failure or exception
        self.stop()
        for turns in self._turns:
            turns.close()

    def _next(self, is_waiting: bool) -> Job | None:
        """Return the next job. None is the end, or an empty queue if ``is_waiting`` is False."""
        try:
            job = self._downloads.take(self._jobs, is_waiting)
        except queue.Empty:
            return None
        if isinstance(job, Exception):
            self._fail(job)
        if isinstance(job, Job):
            if not self.is_stopping:
                return job
            for turns in self._turns:
                turns.end(job)
        self._jobs.put(None)  # ends the other threads
        return None

    def _make_all(self) -> None:
        """Make images until there are no more."""
        decoded: list[JobState] = []
        max_in_flight = MAX_STACK if self.in_flight == 1 else 1
        try:
            while True:
                with self._decoding:  # acquired before taking a job, so that jobs begin in order
                    if job := self._next(not decoded):
                        decoded.append(self._decoded(job, decoded))
                if not decoded:
                    break
                if (
                    not job
                    or len(decoded) >= max_in_flight
                    or not self._renditions.is_small(decoded[-1])
                ):
                    self._make(decoded)
        except BaseException as error:  # an error of the run, not of one image
            self._fail(error)
            self._budget.close()
        finally:
            self._made.put(None)

    def _decoded(self, job: Job, waiting_states: list[JobState]) -> JobState:
        """Decode a job's image.

        Args:
            job: the job.
            waiting_states: jobs that this thread has decoded and not yet developed.
        """
        state = JobState(job, self._worker.loader, job)
        waits: list[float] = []
        leases: list[Lease] = []
        try:
            state = self._downloads.begun(job)
            admit = partial(self._admit, waiting_states, waits, leases, state.decoded)
            self._worker.decode(state, admit)
        except OutputError as error:
            state.fail(error)
            self._fail(error)
        except BaseException as error:  # an error of an image must not end the thread
            state.fail(error)
        finally:
            self._admitting.end(job)
        if leases:
            state.leases = leases
        else:  # no picture is made
            state.close()
        state.decoded = None
        state.spans = [  # subtracts the wait for memory
            replace(span, start=span.start + sum(waits), seconds=span.seconds - sum(waits))
            if span.step == "decode"
            else span
            for span in state.spans
        ]
        return state

    def _begin(self, job: Job) -> JobState:
        return self._worker.begin(job, self._metering.take(job))

    def _admit(
        self,
        waiting_states: list[JobState],
        waits: list[float],
        leases: list[Lease],
        decoded: DecodedFrame | None,
        job: Job,
    ) -> None:
        """Wait until a job's image fits into memory, and take the memory.

        Args:
            waiting_states: as for :meth:`_decoded`.
            waits: gets the seconds of the wait.
            leases: gets the memory.
            decoded: the image, if it was decoded to be metered. It has its memory.
            job: the job, with local files.

        Raises:
            OutputError: the output directory cannot be written to.
            ImageError: the image does not even fit alone.
        """
        if not self._is_checked:
            self._worker.writer.check_folder()
            self._is_checked = True
        self._begin_devices()
        if decoded:
            leases.append(decoded.lease)
            return
        size = self._bytes_of(job)
        start = time.perf_counter()
        self._admitting.wait(job)
        if waiting_states and not self._budget.fits(size):
            self._make(waiting_states)  # frees the memory of the waiting images
        leases.append(self._budget.acquire(size))
        self._admitting.end(job)
        waits.append(time.perf_counter() - start)

    def _acquire_for_metering(self, job: Job) -> Lease:
        """Wait until a frame's image fits into memory, after all frames before, and take it.

        Raises:
            ImageError: the image does not even fit alone, or the run has ended.
        """
        self._begin_devices()
        self._admitting.wait_for_all()
        return self._budget.acquire(self._bytes_of(job))

    def _bytes_of(self, job: Job) -> int:
        """Return the bytes that a job's image takes."""
        return self._worker.bytes_of(job, self._renditions.max_in_flight, None in self.devices)

    def _make(self, decoded: list[JobState]) -> None:
        """Have the renditions of decoded jobs made, and hand the jobs to the committing thread.

        Raises:
            DeviceError, RequestError: no device is left to make them.
        """
        failure: Exception | None = None

        def end_turns() -> None:
            for state in decoded:
                self._developing.end(state.job)

        if not self._developing.wait(decoded[0].job):
            for state in decoded:
                state.fail(ImageError("the run ended before it was developed"))
        try:
            made = self._renditions.develop(decoded, end_turns)
        finally:
            end_turns()
        for state, renditions in zip(decoded, made, strict=True):
            state.free()
            try:
                results = [files.result() for files in renditions]
            except Exception as error:
                failure = error
                for files in renditions:
                    discard(files)
            else:
                self._made.put((state, [written for written in results if written]))
        decoded.clear()
        if failure:
            raise failure

    def _commit_all(self) -> None:
        """Synchronise finished images to the disk, all those that are waiting at once."""
        ended = 0
        try:
            while ended < self.in_flight:
                taken = [self._made.get()]
                with suppress(queue.Empty):
                    while len(taken) < MAX_COMMIT:
                        taken.append(self._made.get_nowait())
                made = [each for each in taken if each]
                ended += taken.count(None)
                self._commit(made)
                for state, _ in made:
                    if state.error_class != "stopped":  # the next run does it
                        self._outcomes.put(state.outcome())
        except BaseException as error:  # an error of the run, not of one image
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
        """Synchronise the renditions of jobs to the disk, and rename them into place."""
        try:
            self._worker.commit([(state, each) for state, files in made for each in files])
        except OutputError as error:
            self._fail(error)
        except BaseException as error:
            for state, _ in made:
                state.fail(error)
