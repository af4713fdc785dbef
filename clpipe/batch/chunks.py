"""Runs whose jobs are done by worker processes, on this machine or on others.

The process that starts such a run gives jobs to the workers in chunks, and gets a report of each
chunk. If a worker dies, each of its jobs is tried once more, without any other job.
"""

import queue
from abc import ABC, abstractmethod
from collections import deque
from collections.abc import Generator, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

from clpipe.base.errors import ClpipeError
from clpipe.batch.outcome import FAILED, Outcome
from clpipe.batch.spec import RunSpec
from clpipe.inputs.find import Job
from clpipe.outputs.folder import remove_unfinished

FIRST_CHUNK, MAX_CHUNK = 4, 64  # number of images in a chunk


@dataclass(frozen=True)
class ChunkReport:
    """What a worker reports.

    Args:
        outcomes: the outcomes of jobs.
        seconds: the time since the worker got its last chunk.
        error: the error that ends the run, if any.
        unfinished: the number of jobs that the worker has begun. It reports them later.
    """

    outcomes: Sequence[Outcome]
    seconds: float
    error: ClpipeError | None = None
    unfinished: int = 0


class WorkerDiedError(Exception):
    """A worker has died. The text says what its image has done."""


@dataclass
class Chunks:
    """The jobs that are left, to be cut into chunks.

    Chunks grow while they take little time, and get smaller towards the end.

    >>> from pathlib import Path
    >>> chunks = Chunks(15.0, 60.0, deque(Job(Path(str(i)), "") for i in range(100)))
    >>> chunks.took(1.0)
    >>> [len(chunks.cut(2)) for _ in range(4)], len(chunks.jobs)
    ([8, 8, 8, 8], 68)
    >>> chunks.took(100.0)
    >>> len(chunks.cut(2)), len(chunks.cut(20)), len(chunks.cut(20, least=6))
    (4, 1, 6)

    Args:
        short: seconds; chunks grow after one that took less time.
        long: seconds; chunks shrink after one that took more time.
        jobs: the jobs that no worker has.
        suspects: jobs whose workers died. Each is tried alone at the end.
        size: the number of jobs in the next chunk.
    """

    short: float
    long: float
    jobs: deque[Job] = field(default_factory=deque)
    suspects: deque[Job] = field(default_factory=deque)
    size: int = FIRST_CHUNK

    def cut(self, count: int, least: int = 1) -> list[Job]:
        """Return the next chunk.

        Args:
            count: the number of chunks that run or wait at a time.
            least: the smallest number of jobs in a chunk, except for the last one.
        """
        size = max(least, min(self.size, len(self.jobs) // (2 * count)))
        return [self.jobs.popleft() for _ in range(min(size, len(self.jobs)))]

    def took(self, seconds: float) -> None:
        """Adapt the size of chunks to the seconds that one took."""
        if seconds < self.short:
            self.size = min(2 * self.size, MAX_CHUNK)
        elif seconds > self.long:
            self.size = max(self.size // 2, 1)


class ChunkExecutor(ABC):
    """An :class:`~clpipe.batch.sinks.Executor` whose jobs are done by workers.

    A derived class submits calls to workers, and puts the future of each call that has ended into
    ``_finished``. ``_held`` contains the jobs of its worker, by their stems.

    Args:
        spec: the run.
        short: as for :class:`Chunks`.
        long: as for :class:`Chunks`.
    """

    def __init__(self, spec: RunSpec, short: float, long: float) -> None:
        self._spec = spec
        self.is_stopping = False
        self._chunks = Chunks(short, long)
        self._finished: queue.SimpleQueue[Any] = queue.SimpleQueue()  # futures; None means stop
        self._held: dict[Any, Mapping[str, Job]] = {}
        self._suspected: set[str] = set()  # the stems of jobs whose worker has died once

    def stop(self) -> None:
        """Begin no more images, and finish those in flight. A signal handler may call it."""
        self.is_stopping = True
        self._finished.put(None)

    @abstractmethod
    def run(self, jobs: Iterable[Job]) -> Generator[Outcome, None, None]:
        """Yield the outcome of each job, see :class:`~clpipe.batch.sinks.Executor`."""

    @abstractmethod
    def _submit_chunks(self) -> bool:
        """Submit the next calls to workers. Return whether any call runs.

        Raises:
            ClpipeError: the run cannot continue.
        """

    @abstractmethod
    def _result(self, future: Any, held: Mapping[str, Job]) -> ChunkReport:
        """Return the report of a call that has ended.

        Args:
            future: the future of the call.
            held: the jobs of its worker.

        Raises:
            WorkerDiedError: the worker has died.
            ClpipeError: the run cannot continue.
        """

    @abstractmethod
    def _halt(self) -> None:
        """Let the workers finish the images in flight, and begin no others."""

    def _localized(self, outcome: Outcome) -> Outcome:
        """Return the outcome of a worker as this process reports it."""
        return outcome

    def _outcomes(self, jobs: Sequence[Job]) -> Generator[Outcome, None, None]:
        """Have every job done, and yield outcomes in any order.

        Raises:
            ClpipeError: the run cannot continue.
        """
        failure: ClpipeError | None = None
        self._chunks.jobs.extend(jobs)
        while self._submit_chunks():
            try:
                future = self._finished.get(timeout=1)
            except queue.Empty:
                continue
            if future is None:
                self._halt()
                continue
            report = self._report(future)
            if report.outcomes:
                self._chunks.took(report.seconds)
            yield from map(self._localized, report.outcomes)
            if report.error:
                failure = failure or report.error
                self.is_stopping = True
                self._halt()
        self._remove_unfinished(jobs)
        if failure:
            raise failure

    def _report(self, future: Any) -> ChunkReport:
        held = self._held.pop(future)
        try:
            return self._result(future, held)
        except WorkerDiedError as death:
            if held.keys() <= self._suspected:
                return self._failed(held, str(death))
            self._suspected |= held.keys()
            self._chunks.suspects.extend(held.values())
            return ChunkReport((), 0.0)

    def _failed(self, held: Mapping[str, Job], reason: str) -> ChunkReport:
        outcomes = [
            Outcome(job, FAILED, error=f"{job.display_name}: {reason}", error_class="unexpected")
            for job in held.values()
        ]
        return ChunkReport(outcomes, self._chunks.long)

    def _remove_unfinished(self, jobs: Sequence[Job]) -> None:
        """Remove the unfinished files of workers that died."""
        patches = self._spec.request.patch is not None
        remove_unfinished(self._spec.execution.output, jobs, patches)
