"""The devices of a run: a thread for each develops ordered renditions, and a pool encodes them."""

import logging
import queue
import threading
from collections import deque
from collections.abc import Callable, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, field
from typing import Any, Generic, TypeVar

from clpipe.base.cpu_time import CpuTimer
from clpipe.base.errors import DeviceError, ImageError, OutputError
from clpipe.batch.job_state import JobState, Written
from clpipe.batch.memory_budget import MemoryBudget
from clpipe.batch.runners import Runners
from clpipe.batch.work import ImageWorker
from clpipe.engine.device import Device
from clpipe.engine.runner import Result
from clpipe.engine.state import has_state
from clpipe.outputs.recipes import Recipe

ENDED = "the run ended before this image was metered"

MAX_STACK = 16  # the most small images that share launches

log = logging.getLogger(__name__)

T = TypeVar("T")


@dataclass
class RenditionTask:
    """A rendition that a device is to compute.

    Args:
        state: the state of its job.
        recipe: its recipe.
        written: resolves to its files, to None if it fails, or to an error if no device is left.
    """

    state: JobState
    recipe: Recipe
    written: Future[Written | None] = field(default_factory=Future)

    def discard(self) -> None:
        """Remove its files."""
        if not self.written.exception() and (written := self.written.result()):
            written.group.discard()


class DeviceCall(Generic[T]):
    """Some work for the thread of a device.

    Args:
        work: gets the device; None is NumPy.

    Attributes:
        written: resolves to its result, or to its error.
    """

    def __init__(self, work: Callable[[Device | None], T]) -> None:
        self._work: Callable[[Device | None], T] | None = work
        self.written: Future[T] = Future()

    def run(self, device: Device | None) -> None:
        """Do the work.

        Raises:
            DeviceError: the device cannot be used any more. Another one can do the work.
        """
        assert self._work
        try:
            result = self._work(device)
        except DeviceError:
            raise
        except BaseException as error:
            self.written.set_exception(error)
        else:
            self.written.set_result(result)
        self._work = None  # it may hold an image


# Groups of orders that were started together. Each group has a function that waits for its result.
Started = deque[deque[tuple[RenditionTask, Callable[[], Result | None]]]]


def no_result() -> None:
    """Stand in for the result of an order that was not started."""


def depth_of(device: Device | None) -> int:
    """Return how many images a device works on at a time; None is NumPy."""
    return device.depth if device else 1


class Developers:
    """Develops and encodes renditions. Each device has a thread, and all share a pool to encode.

    Args:
        worker: does the work of each image.
        devices: the devices; None is NumPy.
        threads: the number of renditions that are encoded at a time.
        budget: notified when a device has compiled its kernels.
        compiled: called at the same time.
        fail: called with an error after which the run cannot continue.
    """

    def __init__(
        self,
        worker: ImageWorker,
        devices: Sequence[Device | None],
        threads: int,
        budget: MemoryBudget,
        compiled: Callable[[], None],
        fail: Callable[[BaseException], None],
    ) -> None:
        self.devices = devices
        # The most renditions of one image that are in flight at a time.
        self.max_in_flight = threads + len(devices)
        self._worker = worker
        self._budget = budget
        self._on_compiled = compiled
        self._fail = fail
        # Small renditions are put together.
        self._tasks: queue.SimpleQueue[list[RenditionTask] | DeviceCall[Any] | None]
        self._tasks = queue.SimpleQueue()
        self._encoders = ThreadPoolExecutor(threads, "encode")
        # Set when the first image has to be developed, and at the end.
        self._is_needed = threading.Event()
        self._is_closing = False
        self._usable = len(devices)
        self._lock = threading.Lock()  # guards the last two attributes

    def begin(self) -> None:
        """Let the devices compile their kernels. A run that skips all images never calls it."""
        self._is_needed.set()

    def close(self) -> None:
        """Let the threads end once all orders are made."""
        with self._lock:
            self._is_closing = True
            for _ in self.devices:
                self._tasks.put(None)
        self._is_needed.set()
        self._encoders.shutdown()

    def on_device(self, work: Callable[[Device | None], T]) -> T:
        """Do some work in the thread of a device, and return its result.

        Raises:
            ImageError: the run has ended.
            DeviceError: no device is usable any more.
        """
        call = DeviceCall(work)
        with self._lock:
            if self._is_closing:
                raise ImageError(ENDED)
            self._tasks.put(call)
        return call.written.result()

    def is_small(self, state: JobState) -> bool:
        """Return whether a small image may share launches with others. With state, it may not."""
        if state.job.place and any(has_state(recipe.chain) for recipe in state.recipes):
            return False
        size = state.source.pixels.shape[1::-1] if state.source else (0, 0)
        return all(each is not None and each.can_stack(*size) for each in self.devices)

    def develop(
        self, states: Sequence[JobState], queued: Callable[[], None]
    ) -> list[list[RenditionTask]]:
        """Compute all renditions of jobs, some at a time, and return them by job when finished.

        ``queued`` is called when all renditions are queued.
        """
        tasks_by_state: list[list[RenditionTask]] = [[] for _ in states]
        pending: deque[RenditionTask] = deque()
        small: list[RenditionTask] = []
        for state, tasks in zip(states, tasks_by_state, strict=True):
            is_small = self.is_small(state)
            if not is_small:
                self._put(small)
            limit = MAX_STACK if is_small else self.max_in_flight
            for recipe in state.recipes:
                # Baselines are matched to the noise of earlier renditions.
                while pending and (len(pending) >= limit or recipe.matcher):
                    self._put(small)
                    pending.popleft().written.exception()
                tasks.append(RenditionTask(state, recipe))
                pending.append(tasks[-1])
                small.append(tasks[-1])
                if not is_small:
                    self._put(small)
        self._put(small)
        queued()
        # Waits for the last task first, so that the others are usually finished.
        for task in reversed(pending):
            task.written.exception()
        return tasks_by_state

    def _put(self, tasks: list[RenditionTask]) -> None:
        """Queue orders, if there are any, and empty the list."""
        if tasks:
            self._tasks.put(tasks.copy())
            tasks.clear()

    def develop_all(self, device: Device | None) -> None:
        """Develop orders until there are no more, or the device fails."""
        self._is_needed.wait()  # if a run skips all images, nothing is compiled
        if self._is_closing:
            self._fail_tasks(ImageError(ENDED))
            return
        pending: list[RenditionTask] = []
        started: Started = deque()
        try:
            try:
                runners = self._worker.runners(device)
                self._on_compiled()
            finally:
                self._budget.device_ready()
            while pending := self._next_tasks(started, device):
                if len(started) >= depth_of(device):
                    self._finish(started, device)
                started.append(self._start_tasks(pending, runners))
                pending = []
        except BaseException as error:
            unfinished = [task for stack in started for task, _ in stack]
            with self._lock:
                self._usable -= 1
                is_last = not self._usable
            if isinstance(error, DeviceError) and not is_last:
                log.warning("%s; the other devices go on", error)
                for task in (*unfinished, *pending):
                    self._tasks.put([task])
                return
            self._fail(error)
            for task in (*unfinished, *pending):
                task.written.set_exception(error)
            self._fail_tasks(error)
        finally:
            if device:
                device.drain()

    def _fail_tasks(self, error: BaseException) -> None:
        """Fail all orders and calls, until the end."""
        for tasks in iter(self._tasks.get, None):
            for task in [tasks] if isinstance(tasks, DeviceCall) else tasks:
                task.written.set_exception(error)

    def _next_tasks(self, started: Started, device: Device | None) -> list[RenditionTask]:
        """Return the next orders: one, several small ones, or none at the end. Calls are done.

        While no order is queued, those that were started are finished.

        Raises:
            DeviceError: the device cannot be used any more.
        """
        taken: list[RenditionTask] = []
        is_waiting = not started
        while len(taken) < MAX_STACK:
            try:
                tasks = self._tasks.get(is_waiting)
            except queue.Empty:
                if taken:
                    break
                self._finish(started, device)
                is_waiting = not started
                continue
            if tasks is None:
                if taken:
                    self._tasks.put(None)  # the next call must also find the end
                    break
                while started:
                    self._finish(started, device)
                return []
            if isinstance(tasks, DeviceCall):
                try:
                    tasks.run(device)
                except DeviceError:
                    for left in (tasks, taken):
                        if left:
                            self._tasks.put(left)
                    raise
                continue
            taken += tasks
            is_waiting = False
            if not self.is_small(tasks[-1].state):
                break
        return taken

    def _start_tasks(
        self, tasks: Sequence[RenditionTask], runners: Runners
    ) -> deque[tuple[RenditionTask, Callable[[], Result | None]]]:
        """Start orders together.

        Raises:
            DeviceError: the device cannot be used any more.
        """
        finishers: list[Callable[[], Result | None]] = [no_result for _ in tasks]
        pending = []
        for place, task in enumerate(tasks):
            state = task.state
            try:
                if not state.error:
                    task.recipe = self._worker.with_matched_noise(state, task.recipe)
                    pending.append((place, (state, task.recipe, runners.of(task.recipe))))
            except BaseException as error:
                state.fail(error)
        try:
            finish_functions = self._worker.start([each for _, each in pending])
            for (place, _), finish in zip(pending, finish_functions, strict=True):
                finishers[place] = finish
        except DeviceError:
            raise
        except BaseException as error:
            for _, (state, *_) in pending:
                state.fail(error)
        return deque(zip(tasks, finishers, strict=True))

    def _finish(self, started: Started, device: Device | None) -> None:
        """Wait for the oldest group of orders, and hand the results to the encoders.

        Raises:
            DeviceError: the device cannot be used any more. Unfinished orders stay in ``started``.
        """
        stack = started[0]
        while stack:
            task, finish = stack[0]
            result = None
            try:
                result = finish()
            except DeviceError:
                raise
            except BaseException as error:
                task.state.fail(error)
            if result:
                self._encoders.submit(self._encode, task, result, device)
            else:
                task.written.set_result(None)
            stack.popleft()
        started.popleft()

    def _encode(self, task: RenditionTask, result: Result, device: Device | None) -> None:
        written = None
        try:
            with CpuTimer("Python"):
                written = self._worker.encode(task.state, task.recipe, result, device)
        except OutputError as error:
            task.state.fail(error)
            self._fail(error)
        except BaseException as error:  # an error of an image must not end the thread
            task.state.fail(error)
        task.written.set_result(written)
