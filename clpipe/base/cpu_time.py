"""CPU time by step, from the clocks of the threads that do it; for benchmarks.

A step is marked where it is done, with :class:`CpuTimer`. That costs well under a microsecond
unless :class:`CpuTimes` counts.
"""

import threading
import time
from contextlib import ContextDecorator
from typing import Self


class CpuTimer(ContextDecorator):
    """Marks what a thread does inside as a step; a context, and a decorator of functions.

    A step within another one counts as the inner one alone.
    """

    def __init__(self, name: str) -> None:
        self.name = name

    def __enter__(self) -> Self:
        if times := CpuTimes.counting:
            times.enter(self.name)
        return self

    def __exit__(self, *error: object) -> None:
        if times := CpuTimes.counting:
            times.leave()


class CpuTimes:
    """CPU time of this process while it is entered; one at a time.

    ``seconds`` is by step, ``elsewhere`` what threads took that were in no step, such as those of a
    device's driver.

    >>> with CpuTimes() as times, CpuTimer("all"):
    ...     with CpuTimer("part"):
    ...         total = sum(range(100_000))
    >>> sorted(times.seconds), times.seconds["part"] > times.seconds["all"] > 0
    (['all', 'part'], True)
    """

    counting: "CpuTimes | None" = None

    def __init__(self) -> None:
        self.seconds: dict[str, float] = {}
        self.elsewhere = 0.0
        self._lock = threading.Lock()  # guards the sums, to which threads add at their end
        self._threads = threading.local()

    def __enter__(self) -> Self:
        self._process = time.process_time()
        CpuTimes.counting = self
        return self

    def __exit__(self, *error: object) -> None:
        CpuTimes.counting = None
        self.elsewhere = time.process_time() - self._process - sum(self.seconds.values())

    def enter(self, name: str) -> None:
        """Begin a step of this thread, in place of the one around it until it is left."""
        self._count()
        self._steps.append(name)

    def leave(self) -> None:
        """End the latest step of this thread; one that began before the counting is not known."""
        if self._steps:
            self._count()
            self._steps.pop()

    @property
    def _steps(self) -> list[str]:
        """The steps that this thread is in, the innermost last."""
        if not hasattr(self._threads, "steps"):
            self._threads.steps = []
        return self._threads.steps

    def _count(self) -> None:
        """Add what this thread took since it was last asked to the step that it is in."""
        now = time.thread_time()
        if self._steps:
            name, seconds = self._steps[-1], now - self._threads.since
            with self._lock:
                self.seconds[name] = self.seconds.get(name, 0.0) + seconds
        self._threads.since = now
