"""CPU time per step, from the clocks of threads; for benchmarks.

:class:`CpuTimer` marks a step in the code. It costs well under a microsecond unless
:class:`CpuTimes` is counting.
"""

import threading
import time
from contextlib import ContextDecorator
from typing import Self


class CpuTimer(ContextDecorator):
    """A context manager and decorator that marks the code inside as a step.

    The time of an inner step does not count for the outer one.
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
    """A context manager that counts this process's CPU time. Only one may be active at a time.

    Attributes:
        seconds: the CPU time of each step, in s.
        elsewhere: the CPU time outside steps, in s, such as that of a driver's threads.

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
        self._lock = threading.Lock()  # guards the sums; each thread adds to them when it ends
        self._threads = threading.local()

    def __enter__(self) -> Self:
        self._process = time.process_time()
        CpuTimes.counting = self
        return self

    def __exit__(self, *error: object) -> None:
        CpuTimes.counting = None
        self.elsewhere = time.process_time() - self._process - sum(self.seconds.values())

    def enter(self, name: str) -> None:
        """Begin a step of this thread. The outer step pauses until :meth:`leave`."""
        self._count()
        self._steps.append(name)

    def leave(self) -> None:
        """End the innermost step of this thread, unless it began before the counting."""
        if self._steps:
            self._count()
            self._steps.pop()

    @property
    def _steps(self) -> list[str]:
        """The open steps of this thread, the innermost last."""
        if not hasattr(self._threads, "steps"):
            self._threads.steps = []
        return self._threads.steps

    def _count(self) -> None:
        """Add this thread's CPU time since the last call to its innermost step."""
        now = time.thread_time()
        if self._steps:
            name, seconds = self._steps[-1], now - self._threads.since
            with self._lock:
                self.seconds[name] = self.seconds.get(name, 0.0) + seconds
        self._threads.since = now
