"""Many images at once: threads that decode, develop and encode, with a few images in flight.

An image is decoded by one thread, each rendition of it is developed by a device's thread and
encoded by another one. A job is let in only when one before it has left, and its image only when
it fits into the memory beside the others, so memory does not grow with the number of jobs.
"""

import logging
import queue
import threading
import time
from collections import deque
from collections.abc import Callable, Generator, Iterable, Iterator, Sequence, Sized
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

from clpipe.base.cpu_time import CpuTimer
from clpipe.base.errors import DeviceError, OutputError, RequestError
from clpipe.base.processors import available_processors
from clpipe.batch.job_state import JobState, failure_text
from clpipe.batch.outcome import FAILED, Outcome
from clpipe.batch.room import Room, usual_room
from clpipe.batch.runners import Runners
from clpipe.batch.work import ImageWorker, Written
from clpipe.engine.device import Device
from clpipe.engine.runner import Result
from clpipe.images.openimageio import set_codec_threads
from clpipe.inputs.find import Job
from clpipe.outputs.recipes import Recipe

# A job and those of its renditions that are not developed yet.
Decoded = tuple[JobState, deque[Recipe]]

# A rendition between a device and its files.
Developed = tuple[JobState, Recipe, Result, Device | None]

# A rendition whose files have not their names yet, None where it failed, and whether it is its
# job's last one.
Encoded = tuple[JobState, Written | None, bool]

TOGETHER = 16  # small images that are developed at a time, at most
COMMITTED = 64  # renditions at a time at most; more would make those that wait for them late


@dataclass(frozen=True)
class Started:
    """A rendition that a device works on, and what waits for its result."""

    decoded: Decoded
    recipe: Recipe
    finish: Callable[[], Result | None]


log = logging.getLogger(__name__)


def depth_of(device: Device | None) -> int:
    """How many images a device works on at a time; None is NumPy."""
    return device.depth if device else 1


def is_small(state: JobState, device: Device | None) -> bool:
    """Whether a job's renditions share launches with others."""
    return bool(device and state.source and device.stacks(*state.source.pixels.shape[1::-1]))


def no_result() -> None:
    """The result of what is not developed."""


class Batch:
    """One run over many images.

    Args:
        worker: what is done to each image.
        devices: where to develop, a thread for each; [None] is NumPy.
        threads: how many decode, and how many encode; None is one for each processor.
        room: bytes that images in flight may take; None is :func:`~clpipe.batch.room.usual_room`.
    """

    def __init__(
        self,
        worker: ImageWorker,
        devices: Sequence[Device | None],
        threads: int | None = None,
        room: int | None = None,
    ) -> None:
        self.devices = list(devices)
        self.threads = threads or available_processors()
        results = self.threads + sum(map(depth_of, self.devices))  # at a time
        self.in_flight = results + 1
        self._worker = worker
        worker.reserve(results)
        self._waiting: Iterator[Job] = iter(())
        self._admitted = 0
        self._developing = len(self.devices)
        self._failure: Exception | None = None
        self._stopping = threading.Event()
        self._broken = self._closing = False
        self._is_needed = threading.Event()  # there is something to develop
        self._lock = threading.Lock()
        self._taking = threading.Lock()  # held while a job is waited for
        self._places = threading.Semaphore(self.in_flight)
        # Jobs without an outcome, or whose outcome nobody has taken; their memory is small.
        self._unfinished = threading.Semaphore(self.in_flight + COMMITTED)
        size = usual_room() if room is None else room
        self._room = Room(size, self.devices, partial(worker.reserve, results))
        self._results = threading.Semaphore(results)
        self._decoded: queue.SimpleQueue[Decoded | None] = queue.SimpleQueue()
        self._developed: queue.SimpleQueue[Developed | None] = queue.SimpleQueue()
        self._encoded: queue.Queue[Encoded | None] = queue.Queue(2 * COMMITTED)
        # None: a thread that decodes has ended, or one of any kind has failed.
        self._outcomes: queue.SimpleQueue[Outcome | None] = queue.SimpleQueue()

    def stop(self) -> None:
        """Let no more images in; those in flight are finished."""
        self._stopping.set()

    @property
    def is_stopping(self) -> bool:
        """Whether no more images are let in."""
        return self._stopping.is_set()

    def run(
        self, jobs: Iterable[Job], wake: Callable[[], None] = lambda: None
    ) -> Generator[Outcome, None, None]:
        """Do every job; one that fails is reported and the others go on. A batch runs once.

        Outcomes come as jobs are finished, in any order.

        Args:
            jobs: the images. What is no list is asked for each when there is a place for it; it may
                take its time, and what it raises ends the run.
            wake: makes it end, where a thread may be waiting for it when the run ends early.

        Raises:
            OutputError: nothing can be written any more. What was in flight is reported before.
            DeviceError: on no device is work possible any more. Where some can still be used, the
                others' work is theirs.
        """
        count = len(jobs) if isinstance(jobs, Sized) else self.threads
        at_a_time = min(self.threads, max(count, 1))
        set_codec_threads(max(available_processors() // at_a_time, 1))
        self._waiting = iter(jobs)
        numbers = range(self.threads)
        decoders = [self._start(f"decode {i}", self._decode_all) for i in numbers]
        developers = [
            self._start(f"device {i}", self._develop_all, device)
            for i, device in enumerate(self.devices)
        ]
        encoders = [self._start(f"encode {i}", self._encode_all) for i in numbers]
        committer = self._start("write", self._commit_all)
        try:
            yield from self._finished(len(decoders))
        finally:
            wake()
            self._close(decoders, developers, encoders, committer)

    def _start(self, name: str, work: Callable[..., None], *arguments: Any) -> threading.Thread:
        """Start a thread. An error that it does not handle ends the run."""

        def guarded() -> None:
            try:
                with CpuTimer("Python"):
                    work(*arguments)
            except BaseException as error:
                self._fail(error if isinstance(error, Exception) else RuntimeError(repr(error)))
                self._broken = True
                self._outcomes.put(None)

        thread = threading.Thread(target=guarded, name=name, daemon=True)
        try:
            thread.start()
        except RuntimeError:  # the system gives no more, or their stacks do not fit
            raise RequestError(
                f"--jobs: {self.threads}: no thread can be started for '{name}'; ask for fewer, or "
                "allow more threads (ulimit -u) or memory (ulimit -v)"
            ) from None
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
            self._unfinished.release()
            yield outcome
        if self._failure:
            raise self._failure

    def _close(
        self,
        decoders: Sequence[threading.Thread],
        developers: Sequence[threading.Thread],
        encoders: Sequence[threading.Thread],
        committer: threading.Thread,
    ) -> None:
        """Let all threads end, also those that wait."""
        self.stop()
        self._closing = True
        self._is_needed.set()
        self._room.open()
        for _ in decoders:
            self._unfinished.release()
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
        self._encoded.put(None)
        committer.join()

    def _next(self) -> Job | None:
        """The next job, once there is a place for it; None where none is to come."""
        self._unfinished.acquire()
        self._places.acquire()
        with self._taking:
            if self._stopping.is_set():
                return None
            job = next(self._waiting, None)
            if job is None or self._stopping.is_set():
                return None
            self._admitted += 1
            return job

    def _decode_all(self) -> None:
        while job := self._next():
            waits: list[float] = []
            try:
                state = self._worker.decode(job, partial(self._admit, waits))
            except OutputError as error:
                self._leave(job)
                self._outcomes.put(Outcome(job, FAILED, error=failure_text(job, error)))
                self._fail(error)
                continue
            except BaseException as error:  # nothing that one image does may end the thread
                self._leave(job)
                self._outcomes.put(Outcome(job, FAILED, error=failure_text(job, error)))
                continue
            for seconds in waits:  # for room, which is no decoding
                (span,) = state.spans
                start = span.start + seconds
                state.spans = [replace(span, start=start, seconds=span.seconds - seconds)]
            if state.recipes:
                self._decoded.put((state, deque(state.recipes)))
            else:
                self._leave(job)
                self._outcomes.put(state.outcome())
            del state
        self._unfinished.release()  # for the next thread, which has no job to wait for either
        self._places.release()
        self._outcomes.put(None)

    def _admit(self, waits: list[float], job: Job) -> None:
        """Wait until there is room for a job's image, and note how long: it is decoded next.

        Raises:
            OutputError: the first image of the run is to be made, but cannot be written.
        """
        worker, writer = self._worker, self._worker.writer
        if not self._is_needed.is_set():
            writer.check_folder()
        self._is_needed.set()
        size = worker.bytes_of(job, self.threads + len(self.devices), None in self.devices)
        start = time.perf_counter()
        self._room.enter(job.stem, size)
        waits.append(time.perf_counter() - start)

    def _develop_all(self, device: Device | None) -> None:
        self._is_needed.wait()  # a run that makes nothing compiles nothing
        if self._closing:
            return
        decoded: list[Decoded] = []
        started: deque[deque[Started]] = deque()
        try:
            try:
                runners = self._worker.runners(device)
            finally:
                self._room.started()
            while decoded := self._next_decoded(started, device):
                self._develop(decoded, started, runners, device)
                decoded = []  # or its memory would be held until there is another one
        except DeviceError as error:
            with self._lock:
                self._developing -= 1
                is_last = not self._developing
            if is_last:
                raise
            log.warning("%s; the other devices go on", error)
            left = [each for stack in started for each in stack]
            jobs = [*(each.decoded for each in left), *decoded]
            for each in {id(each): each for each in jobs}.values():
                self._decoded.put(each)
            for _ in left:
                self._results.release()
        finally:
            if device:
                device.drain()

    def _next_decoded(self, started: deque[deque[Started]], device: Device | None) -> list[Decoded]:
        """The next job, or a few small ones that wait, and none at the end.

        What is started does not wait for it.
        """
        first: Decoded | None = None
        while started and not first:
            try:
                first = self._decoded.get_nowait()
            except queue.Empty:
                self._finish(started, device)
                continue
            while started and not first:
                self._finish(started, device)
            if not first:
                return []
        first = first or self._decoded.get()
        decoded = [first] if first else []
        while decoded and len(decoded) < TOGETHER and is_small(decoded[-1][0], device):
            try:
                following = self._decoded.get_nowait()
            except queue.Empty:
                break
            if not following:
                self._decoded.put(None)  # for the next time
                break
            decoded.append(following)
        return decoded

    def _develop(
        self,
        decoded: Sequence[Decoded],
        started: deque[deque[Started]],
        runners: Runners,
        device: Device | None,
    ) -> None:
        """Start what is left of jobs, and finish what a device cannot have beside that.

        Raises:
            DeviceError: the device cannot be used any more; what it did not finish is left.
        """
        waiting = deque((each, recipe) for each in decoded for recipe in each[1])
        while waiting:
            while not self._results.acquire(blocking=not started):
                self._finish(started, device)
            if self._broken:
                return
            stack = [waiting.popleft()]
            while stack[-1][1].spread and started:  # its noise is measured on those before it
                self._finish(started, device)
            while (
                waiting
                and is_small(stack[-1][0][0], device)
                and not waiting[0][1].spread
                and self._results.acquire(blocking=False)
            ):
                stack.append(waiting.popleft())
            started.append(self._started(stack, runners))
            if len(started) >= depth_of(device):
                self._finish(started, device)

    def _started(self, stack: Sequence[tuple[Decoded, Recipe]], runners: Runners) -> deque[Started]:
        """Start renditions together.

        Raises:
            DeviceError: the device cannot be used any more.
        """
        begun, asked = [Started(*each, no_result) for each in stack], []
        for place, ((state, _), recipe) in enumerate(stack):
            try:
                if not state.error:
                    own = self._worker.measured(state, recipe)
                    asked.append((place, (state, own, runners.of(own))))
            except BaseException as error:
                state.error = failure_text(state.job, error)
        try:
            waits = self._worker.start([own for _, own in asked])
            for (place, (_, recipe, _)), wait in zip(asked, waits, strict=True):
                begun[place] = Started(stack[place][0], recipe, wait)
        except DeviceError:
            for _ in stack:
                self._results.release()
            raise
        except BaseException as error:
            for _, (state, *_) in asked:
                state.error = failure_text(state.job, error)
        return deque(begun)

    def _finish(self, started: deque[deque[Started]], device: Device | None) -> None:
        """Wait for the renditions that were started first, together, and hand them on.

        Raises:
            DeviceError: the device cannot be used any more; what is not finished stays started.
        """
        stack = started[0]
        while stack:
            state, left = stack[0].decoded
            result = None
            try:
                result = stack[0].finish()
            except DeviceError:
                raise
            except BaseException as error:
                state.error = failure_text(state.job, error)
            recipe = stack.popleft().recipe
            left.popleft()
            if result:
                self._developed.put((state, recipe, result, device))
            else:
                self._hand_on(state, None)
        started.popleft()

    def _encode_all(self) -> None:
        while developed := self._developed.get():
            state = developed[0]
            written = None
            try:
                written = self._worker.encode(*developed)
            except OutputError as error:
                state.error = f"{state.job.shown}: {error}"
                self._fail(error)
            except BaseException as error:
                state.error = failure_text(state.job, error)
            self._hand_on(state, written)
            del developed, state

    def _hand_on(self, state: JobState, written: Written | None) -> None:
        """One rendition less to wait for; with the last one the job's memory is free."""
        self._results.release()
        with self._lock:  # so that the last one comes behind the others
            state.unwritten -= 1
            is_last = state.unwritten == 0
            if is_last:
                state.drop_pixels()
                self._leave(state.job)
            self._encoded.put((state, written, is_last))

    def _leave(self, job: Job) -> None:
        """Give a job's place, and its room in memory, to others."""
        self._room.leave(job.stem)
        self._places.release()

    def _commit_all(self) -> None:
        """Bring to the disk, together, what was encoded while the disk had the renditions before.

        In the order in which they were encoded, so that a job's outcome follows its last rendition.
        """
        while first := self._encoded.get():
            taken: list[Encoded] = [first]
            while len(taken) < COMMITTED:
                try:
                    encoded = self._encoded.get_nowait()
                except queue.Empty:
                    break
                if encoded is None:
                    self._encoded.put(None)  # for the loop's end
                    break
                taken.append(encoded)
            try:
                self._worker.commit([(state, files) for state, files, _ in taken if files])
            except OutputError as error:
                self._fail(error)
            except BaseException as error:
                for state, _, _ in taken:
                    state.error = failure_text(state.job, error)
            for state, _, is_last in taken:
                if is_last:
                    self._outcomes.put(state.outcome())
