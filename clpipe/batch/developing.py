"""The renditions of a run: a service develops them on its devices, and a pool encodes them."""

from collections import deque
from collections.abc import Callable, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from functools import partial

from clpipe.base.cpu_time import CpuTimer
from clpipe.base.errors import DeviceError, OutputError
from clpipe.batch.job_state import JobState, Written
from clpipe.batch.memory_budget import MemoryBudget
from clpipe.batch.work import ImageWorker
from clpipe.engine.device import Device
from clpipe.engine.runner import Result
from clpipe.engine.service import MAX_STACK, Development, Frame, Service
from clpipe.engine.state import has_state
from clpipe.outputs.recipes import Recipe

# Resolves to the files of a rendition, to None if it fails, or to an error if no device is left.
Files = Future[Written | None]


class Developing:
    """Develops and encodes renditions.

    Args:
        worker: does the work of each image.
        devices: the devices; None is NumPy.
        threads: the number of renditions that are encoded at a time.
        budget: notified when a device has compiled its kernels.
        fail: called with an error after which the run cannot continue.

    Attributes:
        service: develops renditions, and the frames that are metered.
        max_in_flight: the most renditions of one image that are in flight at a time.
    """

    def __init__(
        self,
        worker: ImageWorker,
        devices: Sequence[Device | None],
        threads: int,
        budget: MemoryBudget,
        fail: Callable[[BaseException], None],
    ) -> None:
        self.service = Service(devices, self._prepare)
        self.max_in_flight = threads + len(devices)
        self._worker = worker
        self._budget = budget
        self._fail = fail
        self._encoders = ThreadPoolExecutor(threads, "encode")
        self._error: BaseException | None = None  # why no device can be used

    def _prepare(self, device: Device | None) -> None:
        """Compile the kernels of the first chain, in the thread of a device.

        Raises:
            RequestError: the memory of the device is too small for any image.
            DeviceError: a kernel does not compile.
        """
        try:
            self._worker.compile(device)
        except DeviceError:
            raise
        except BaseException as error:
            self._error = error
            self._fail(error)
            raise
        finally:
            self._budget.device_ready()

    def begin(self) -> None:
        """Let the devices compile their kernels. A run that skips all images never calls it.

        Raises:
            RuntimeError: the system allows no more threads.
        """
        self.service.start()

    def close(self) -> None:
        """Finish all renditions."""
        self.service.close()
        self._encoders.shutdown()

    def is_small(self, state: JobState) -> bool:
        """Return whether a small image may share launches with others. With state, it may not."""
        if state.job.place and any(has_state(recipe.chain) for recipe in state.recipes):
            return False
        size = state.source.pixels.shape[1::-1] if state.source else (0, 0)
        return all(each is not None and each.can_stack(*size) for each in self.service.devices)

    def develop(self, states: Sequence[JobState], queued: Callable[[], None]) -> list[list[Files]]:
        """Make all renditions of jobs, some at a time, and return them by job when finished.

        ``queued`` is called when all renditions are queued.
        """
        files_by_state: list[list[Files]] = [[] for _ in states]
        pending: deque[Files] = deque()
        small: list[tuple[JobState, Recipe, Frame, Files]] = []
        for state, files in zip(states, files_by_state, strict=True):
            is_small = self.is_small(state)
            if not is_small:
                self._start(small)
            limit = MAX_STACK if is_small else self.max_in_flight
            for recipe in state.recipes:
                # Baselines are matched to the noise of earlier renditions.
                while pending and (len(pending) >= limit or recipe.matcher):
                    self._start(small)
                    pending.popleft().exception()
                files.append(Future())
                pending.append(files[-1])
                ordered = self._worker.order(state, recipe, is_small)
                if ordered is None:
                    files[-1].set_result(None)
                    continue
                small.append((state, *ordered, files[-1]))
                if not is_small:
                    self._start(small)
        self._start(small)
        queued()
        # Waits for the last one first, so that the others are usually finished.
        for each in reversed(pending):
            each.exception()
        return files_by_state

    def _start(self, ordered: list[tuple[JobState, Recipe, Frame, Files]]) -> None:
        """Develop frames together, if there are any, and empty the list."""
        if not ordered:  # a run that skips all images starts no device
            return
        developments = self.service.develop([frame for _, _, frame, _ in ordered])
        for development, (state, recipe, _, files) in zip(developments, ordered, strict=True):
            development.add_done_callback(partial(self._finish, state, recipe, files))
        ordered.clear()

    def _finish(
        self, state: JobState, recipe: Recipe, files: Files, development: Future[Result]
    ) -> None:
        """Hand the result of a rendition to the encoders, in the thread of its device."""
        assert isinstance(development, Development)
        error = development.exception()
        if error and (isinstance(error, DeviceError) or error is self._error):
            self._fail(error)
            files.set_exception(error)
            return
        result = None
        try:
            result = self._worker.finish(state, recipe, development)
        except BaseException as problem:  # an error of an image must not end the thread
            state.fail(problem)
        if not result:
            files.set_result(None)
            return
        try:
            self._encoders.submit(self._encode, state, recipe, result, development.device, files)
        except RuntimeError as problem:  # the system allows no more threads
            self._fail(problem)
            files.set_exception(problem)

    def _encode(
        self, state: JobState, recipe: Recipe, result: Result, device: Device | None, files: Files
    ) -> None:
        if files.done():  # the run has failed, but the pool has kept the call
            return
        written = None
        try:
            with CpuTimer("Python"):
                written = self._worker.encode(state, recipe, result, device)
        except OutputError as error:
            state.fail(error)
            self._fail(error)
        except BaseException as error:  # an error of an image must not end the thread
            state.fail(error)
        files.set_result(written)


def discard(files: Files) -> None:
    """Remove the files of a rendition."""
    if not files.exception() and (written := files.result()):
        written.group.discard()
