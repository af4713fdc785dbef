"""Many images in one thread: all of one, or of a few small ones, is done, then the next is begun;
a second thread only waits for the disk.

A process that has one processor needs no more. In :class:`clpipe.batch.threads.Batch` threads take
turns at the interpreter's lock some fifty times an image, which of a small image's time is a third.
"""

import queue
import threading
from collections import deque
from collections.abc import Callable, Generator, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import contextmanager
from functools import partial

from clpipe.base.errors import ClpipeError, DeviceError, OutputError
from clpipe.batch.job_state import JobState, failure_text
from clpipe.batch.outcome import Outcome
from clpipe.batch.room import Room
from clpipe.batch.runners import Runners
from clpipe.batch.threads import TOGETHER, is_small
from clpipe.batch.work import ImageWorker, Written
from clpipe.engine.device import Device
from clpipe.engine.runner import Result, Runner
from clpipe.images.openimageio import set_codec_threads
from clpipe.inputs.find import Job
from clpipe.outputs.recipes import Recipe

Jobs = queue.SimpleQueue[Job | None]  # None: there are no more

Made = tuple[JobState, list[Written]]  # a job, and its renditions, which have no names yet


class InTurn:
    """One run over many images, one after the other.

    Args:
        worker: what is done to each image.
        device: where to develop; None is NumPy.
        room: bytes that an image may take; None is no limit.
        compiled: is called when the kernels are.
    """

    def __init__(
        self,
        worker: ImageWorker,
        device: Device | None,
        room: int | None,
        compiled: Callable[[], None],
    ) -> None:
        self._worker = worker
        self._tell = compiled
        self._device = device
        worker.reserve(1)
        self._room = Room(room, [device], partial(worker.reserve, 1))
        self._runners: Runners | None = None
        self._decoded: list[JobState] = []
        self._made: list[Made] = []
        self._failure: ClpipeError | None = None
        self._stopping = threading.Event()

    def stop(self) -> None:
        """Begin no more images. May be called by another thread."""
        self._stopping.set()

    def run(self, jobs: Jobs) -> Generator[Outcome, None, None]:
        """Do every job, as :meth:`clpipe.batch.threads.Batch.run` does.

        Outcomes of several jobs come together, at the latest when no job waits.

        Raises:
            OutputError: nothing can be written any more.
            DeviceError: the device cannot be used any more.
        """
        set_codec_threads(1)
        committing: Future[list[Outcome]] | None = None
        with ThreadPoolExecutor(1, "write") as beside:
            try:
                while True:
                    try:
                        job = jobs.get_nowait()
                    except queue.Empty:
                        self._develop()
                        yield from committing.result() if committing else ()
                        committing = None
                        yield from self._commit(self._taken())
                        if self._stopping.is_set():
                            break
                        job = jobs.get()
                    if job is None or self._stopping.is_set():
                        break
                    self._begin(job)
                    if len(self._made) >= TOGETHER:
                        yield from committing.result() if committing else ()
                        committing = beside.submit(self._commit, self._taken())
                self._develop()
                yield from committing.result() if committing else ()
                yield from self._commit(self._taken())
            finally:
                for _, files in self._taken():
                    for each in files:
                        each.group.discard()
                if self._device:
                    self._device.drain()
        if self._failure:
            raise self._failure

    def _taken(self) -> list[Made]:
        """What was made since the last time."""
        made, self._made = self._made, []
        return made

    def _begin(self, job: Job) -> None:
        """Decode a job's image, and develop it with those before it unless more may follow."""
        state = JobState(job, self._worker.loader)
        with self._errors_of(state):
            state = self._worker.decode(job, self._admit)
        self._decoded.append(state)
        if len(self._decoded) >= TOGETHER or not is_small(state, self._device):
            self._develop()

    def _develop(self) -> None:
        """Do what is left of the jobs that are decoded, but bring nothing to the disk."""
        states, self._decoded = self._decoded, []
        files: list[list[Written]] = [[] for _ in states]
        left = deque((i, recipe) for i, state in enumerate(states) for recipe in state.recipes)
        while left:
            asked: list[tuple[int, Recipe, Runner]] = []
            # The noise of some is measured on those before them.
            while left and len(asked) < TOGETHER and not (asked and left[0][1].spread):
                place, recipe = left.popleft()
                state = states[place]
                if not state.error:
                    with self._errors_of(state):
                        recipe = self._worker.measured(state, recipe)
                        asked.append((place, recipe, self._compiled().of(recipe)))
                if not is_small(state, self._device):
                    break
            begun: list[Callable[[], Result | None]] = []
            try:
                begun = self._worker.start(
                    [(states[place], recipe, runner) for place, recipe, runner in asked]
                )
            except BaseException as error:
                for place, *_ in asked:
                    with self._errors_of(states[place]):
                        raise error
            for (place, recipe, _), wait in zip(asked, begun, strict=False):
                with self._errors_of(state := states[place]):
                    result = wait()
                    written = result and self._worker.encode(state, recipe, result, self._device)
                    files[place] += [written] if written else []
        for state in states:
            state.drop_pixels()
            self._room.leave(state.job.stem)
        self._made += zip(states, files, strict=True)

    @contextmanager
    def _errors_of(self, state: JobState) -> Iterator[None]:
        """What fails within fails one job, unless it is of what all that follows needs."""
        try:
            yield
        except (OutputError, DeviceError) as error:
            state.error = failure_text(state.job, error)
            self._fail(error)
        except BaseException as error:
            state.error = failure_text(state.job, error)

    def _compiled(self) -> Runners:
        """The device's runners; kernels are compiled at the first call.

        Raises:
            DeviceError: one does not compile.
        """
        if self._runners is None:
            self._runners = self._worker.runners(self._device)
            self._tell()
        return self._runners

    def _admit(self, job: Job) -> None:
        """See that there is room for a job's image.

        Raises:
            OutputError: the first image of the run is to be made, but cannot be written.
            ImageError: there is none.
        """
        if self._runners is None:
            self._worker.writer.check_folder()
            try:
                self._compiled()
            except ClpipeError as error:  # of which all that follows would fail
                self._fail(error)
                raise
            self._room.started()
        size = self._worker.bytes_of(job, 1, self._device is None)
        if self._decoded and not self._room.fits(size):
            self._develop()  # and give their memory back
        self._room.enter(job.stem, size)

    def _commit(self, made: Sequence[Made]) -> list[Outcome]:
        """Bring to the disk what was made; the outcomes."""
        try:
            self._worker.commit([(state, each) for state, files in made for each in files])
        except OutputError as error:
            self._fail(error)
        except BaseException as error:
            for state, _ in made:
                state.error = failure_text(state.job, error)
        return [state.outcome() for state, _ in made]

    def _fail(self, error: ClpipeError) -> None:
        self._failure = self._failure or error
        self.stop()
