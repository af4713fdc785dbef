"""Fetches the files of jobs at URLs before a thread decodes them."""

import queue
import threading
from collections import deque
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import suppress

from clpipe.base.cpu_time import CpuTimer
from clpipe.base.urls import may_be_url
from clpipe.batch.job_state import JobState
from clpipe.inputs.find import Job

Item = Job | Exception | None  # None marks the end; an error ends the run
Jobs = queue.SimpleQueue[Item]

THREADS = 4  # jobs that are fetched at a time
MAX_AHEAD = 16  # jobs that are fetched, or being fetched, before a thread takes them
MAX_BYTES = 256 << 20  # approximate size of their files


class Downloads:
    """Takes jobs from a queue in order, and begins the next ones if their files are at URLs.

    Args:
        begin: finds what a job needs, and fetches its files.
    """

    def __init__(self, begin: Callable[[Job], JobState]) -> None:
        self._begin = begin
        self._taking = threading.Lock()  # lets one thread take a job at a time
        self._ahead: deque[Item] = deque()  # what was taken from the queue too early
        self._begun: dict[str, Future[JobState]] = {}  # by the stem of the job
        self._largest = 1  # bytes; the largest files of a job so far
        self._pool: ThreadPoolExecutor | None = None

    def take(self, jobs: Jobs, is_waiting: bool) -> Item:
        """Return the next item of a queue.

        Raises:
            queue.Empty: there is none now, and ``is_waiting`` is False.
        """
        with self._taking:
            item = self._ahead.popleft() if self._ahead else jobs.get(is_waiting)
            if isinstance(item, Job) and may_be_url(item.path):
                count = min(max(MAX_BYTES // self._largest, 1), MAX_AHEAD)
                with suppress(queue.Empty):
                    while len(self._ahead) < count:
                        self._ahead.append(later := jobs.get_nowait())
                        if isinstance(later, Job) and may_be_url(later.path):
                            self._pool = self._pool or ThreadPoolExecutor(THREADS, "fetch")
                            self._begun[later.stem] = self._pool.submit(self._fetch, later)
            return item

    def begun(self, job: Job) -> JobState:
        """Return the state of a job that was taken, begun."""
        future = self._begun.pop(job.stem, None)
        return future.result() if future else self._begin(job)

    def close(self) -> None:
        """Remove the files of jobs that no thread has taken."""
        if self._pool:
            self._pool.shutdown(cancel_futures=True)
        for future in self._begun.values():
            if not future.cancelled() and not future.exception():
                future.result().close()
        self._begun.clear()

    def _fetch(self, job: Job) -> JobState:
        with CpuTimer("Python"):
            state = self._begin(job)
        if state.here is not job:
            size = sum(path.stat().st_size for path in state.here.paths)
            self._largest = max(self._largest, size)
        return state
