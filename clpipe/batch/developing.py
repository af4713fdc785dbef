"""The devices of a run: a thread for each develops ordered renditions, and a pool encodes them."""

import logging
import queue
import threading
from collections import deque
from collections.abc import Callable, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, field
from itertools import chain

from clpipe.base.cpu_time import CpuTimer
from clpipe.base.errors import DeviceError, OutputError
from clpipe.batch.job_state import JobState, failure_text
from clpipe.batch.memory_budget import MemoryBudget
from clpipe.batch.runners import Runners
from clpipe.batch.work import ImageWorker, Written
from clpipe.engine.device import Device
from clpipe.engine.runner import Result
from clpipe.outputs.recipes import Recipe

TOGETHER = 16  # most small images that share launches

log = logging.getLogger(__name__)


@dataclass
class Order:
    """A rendition that a device shall make.

    Args:
        state: its job.
        recipe: how it is made.
        written: resolves to its files; to None if it fails, and to an error if no device is left.
    """

    state: JobState
    recipe: Recipe
    written: Future[Written | None] = field(default_factory=Future)

    def discard(self) -> None:
        """Remove its files."""
        if not self.written.exception() and (written := self.written.result()):
            written.group.discard()


# Groups of orders that were started together, each with a function that waits for its result.
Started = deque[deque[tuple[Order, Callable[[], Result | None]]]]


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
        self.most = threads + len(devices)  # renditions of one image that are in flight at a time
        self._worker = worker
        self._budget = budget
        self._tell = compiled
        self._fail = fail
        self._orders: queue.SimpleQueue[list[Order] | None] = (
            queue.SimpleQueue()
        )  # small ones together
        self._encoders = ThreadPoolExecutor(threads, "encode")
        self._is_needed = threading.Event()  # set by the first image to be made, and at the end
        self._is_closing = False
        self._usable = len(devices)
        self._counting = threading.Lock()  # guards the number of usable devices

    @property
    def is_needed(self) -> bool:
        """Whether an image has asked for kernels."""
        return self._is_needed.is_set()

    def begin(self) -> None:
        """Let the devices compile their kernels. A run that skips all images never calls it."""
        self._is_needed.set()

    def close(self) -> None:
        """Let the threads end once all orders are made."""
        self._is_closing = True
        self._is_needed.set()
        for _ in self.devices:
            self._orders.put(None)
        self._encoders.shutdown()

    def is_small(self, state: JobState) -> bool:
        """Return whether a job's image is small enough to share launches with others."""
        size = state.source.pixels.shape[1::-1] if state.source else (0, 0)
        return all(each is not None and each.can_stack(*size) for each in self.devices)

    def order(self, states: Sequence[JobState]) -> list[list[Order]]:
        """Make all renditions of jobs, some at a time, and wait. Returns them by job."""
        made: list[list[Order]] = [[] for _ in states]
        asked: deque[Order] = deque()
        small: list[Order] = []
        for state, orders in zip(states, made, strict=True):
            is_small = self.is_small(state)
            if not is_small:
                self._put(small)
            most = TOGETHER if is_small else self.most
            for recipe in state.recipes:
                # Baselines take their noise from the renditions before them.
                while asked and (len(asked) >= most or recipe.spread):
                    self._put(small)
                    asked.popleft().written.exception()
                orders.append(Order(state, recipe))
                asked.append(orders[-1])
                small.append(orders[-1])
                if not is_small:
                    self._put(small)
        self._put(small)
        for order in reversed(asked):  # the last one first, so as to wait once
            order.written.exception()
        return made

    def _put(self, orders: list[Order]) -> None:
        """Queue orders, if there are any, and empty the list."""
        if orders:
            self._orders.put(orders.copy())
            orders.clear()

    def develop_all(self, device: Device | None) -> None:
        """Develop orders until there are no more, or the device fails."""
        self._is_needed.wait()  # a run that skips all images compiles nothing
        if self._is_closing:
            return
        asked: list[Order] = []
        started: Started = deque()
        try:
            try:
                runners = self._worker.runners(device)
                self._tell()
            finally:
                self._budget.device_ready()
            while asked := self._taken(started, device):
                if len(started) >= depth_of(device):
                    self._finish(started, device)
                started.append(self._started(asked, runners))
                asked = []
        except BaseException as error:
            left = [order for stack in started for order, _ in stack]
            with self._counting:
                self._usable -= 1
                is_last = not self._usable
            if isinstance(error, DeviceError) and not is_last:
                log.warning("%s; the other devices go on", error)
                for order in (*left, *asked):
                    self._orders.put([order])
                return
            self._fail(error)
            for order in chain(left, asked, chain.from_iterable(iter(self._orders.get, None))):
                order.written.set_exception(error)
        finally:
            if device:
                device.drain()

    def _taken(self, started: Started, device: Device | None) -> list[Order]:
        """Return the next orders: one, several small ones, or none at the end.

        While no order is queued, those that were started are finished.

        Raises:
            DeviceError: the device cannot be used any more.
        """
        taken: list[Order] = []
        is_waiting = not started
        while len(taken) < TOGETHER:
            try:
                orders = self._orders.get(is_waiting)
            except queue.Empty:
                if taken:
                    break
                self._finish(started, device)
                is_waiting = not started
                continue
            if orders is None:
                if taken:
                    self._orders.put(None)  # for the next call
                    break
                while started:
                    self._finish(started, device)
                return []
            taken += orders
            is_waiting = False
            if not self.is_small(orders[-1].state):
                break
        return taken

    def _started(
        self, orders: Sequence[Order], runners: Runners
    ) -> deque[tuple[Order, Callable[[], Result | None]]]:
        """Start orders together.

        Raises:
            DeviceError: the device cannot be used any more.
        """
        waits: list[Callable[[], Result | None]] = [no_result for _ in orders]
        asked = []
        for place, order in enumerate(orders):
            state = order.state
            try:
                if not state.error:
                    order.recipe = self._worker.measured(state, order.recipe)
                    asked.append((place, (state, order.recipe, runners.of(order.recipe))))
            except BaseException as error:
                state.error = failure_text(state.job, error)
        try:
            begun = self._worker.start([each for _, each in asked])
            for (place, _), finish in zip(asked, begun, strict=True):
                waits[place] = finish
        except DeviceError:
            raise
        except BaseException as error:
            for _, (state, *_) in asked:
                state.error = failure_text(state.job, error)
        return deque(zip(orders, waits, strict=True))

    def _finish(self, started: Started, device: Device | None) -> None:
        """Wait for the oldest group of orders, and hand the results to the encoders.

        Raises:
            DeviceError: the device cannot be used any more. Unfinished orders stay in ``started``.
        """
        stack = started[0]
        while stack:
            order, finish = stack[0]
            result = None
            try:
                result = finish()
            except DeviceError:
                raise
            except BaseException as error:
                order.state.error = failure_text(order.state.job, error)
            if result:
                self._encoders.submit(self._encode, order, result, device)
            else:
                order.written.set_result(None)
            stack.popleft()
        started.popleft()

    def _encode(self, order: Order, result: Result, device: Device | None) -> None:
        written = None
        try:
            with CpuTimer("Python"):
                written = self._worker.encode(order.state, order.recipe, result, device)
        except OutputError as error:
            order.state.error = failure_text(order.state.job, error)
            self._fail(error)
        except BaseException as error:  # no image may end a thread
            order.state.error = failure_text(order.state.job, error)
        order.written.set_result(written)
