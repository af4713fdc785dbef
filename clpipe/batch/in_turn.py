"""Many images in one thread: all of one is done, then the next is begun; a second one only waits
for the disk.

A process that has one processor needs no more. In :class:`clpipe.batch.threads.Batch` threads take
turns at the interpreter's lock some fifty times an image, which of a small image's time is a third.
"""

import queue
import threading
from collections.abc import Callable, Generator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from functools import partial

from clpipe.base.errors import ClpipeError, DeviceError, OutputError
from clpipe.batch.job_state import JobState, failure_text
from clpipe.batch.outcome import Outcome
from clpipe.batch.room import Room
from clpipe.batch.runners import Runners
from clpipe.batch.work import ImageWorker, Written
from clpipe.engine.device import Device
from clpipe.images.openimageio import set_codec_threads
from clpipe.inputs.find import Job

TOGETHER = 16  # images that are brought to the disk at a time, at most

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
        made: list[Made] = []
        committing: Future[list[Outcome]] | None = None
        with ThreadPoolExecutor(1, "write") as beside:
            try:
                while True:
                    try:
                        job = jobs.get_nowait()
                    except queue.Empty:
                        yield from committing.result() if committing else ()
                        committing = None
                        yield from self._commit(made)
                        made = []
                        if self._stopping.is_set():
                            break
                        job = jobs.get()
                    if job is None or self._stopping.is_set():
                        break
                    made.append(self._make(job))
                    if len(made) >= TOGETHER:
                        yield from committing.result() if committing else ()
                        committing = beside.submit(self._commit, made)
                        made = []
                yield from committing.result() if committing else ()
                yield from self._commit(made)
                made = []
            finally:
                for _, files in made:
                    for each in files:
                        each.group.discard()
                if self._device:
                    self._device.drain()
        if self._failure:
            raise self._failure

    def _make(self, job: Job) -> Made:
        """Do all of a job, but bring nothing to the disk."""
        worker = self._worker
        state, files = JobState(job, worker.loader), list[Written]()
        try:
            state = worker.decode(job, self._admit)
            for asked in tuple(state.recipes):
                if state.error:
                    break
                recipe = worker.measured(state, asked)
                result = worker.develop(state, recipe, self._compiled().of(recipe))
                written = result and worker.encode(state, recipe, result, self._device)
                files += [written] if written else []
        except (OutputError, DeviceError) as error:  # of which all that follows would fail
            state.error = failure_text(job, error)
            self._fail(error)
        except BaseException as error:  # nothing that one image does may end the run
            state.error = failure_text(job, error)
        state.drop_pixels()
        self._room.leave(job.stem)
        return state, files

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
        self._room.enter(job.stem, self._worker.bytes_of(job, 1, self._device is None))

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
