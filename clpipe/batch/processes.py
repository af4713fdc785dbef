"""Processes on this machine that share a run, each with its part of the processors and devices.

One Python process computes at most a few hundred small images per second on any number of
processors, because its threads share the interpreter's lock. A run therefore has several processes
if they save time. This process holds the output directory and the log, distributes jobs, and
collects outcomes. Each of the others runs a :class:`clpipe.batch.threads.Batch`, and is the only
worker of a pool of Loky. Unlike the pools of the standard library, these do not import the script
that starts the run. If a process dies, others get its jobs. Sidecars show which are finished.
"""

import logging
import multiprocessing
import os
import re
import threading
from collections import Counter
from collections.abc import Generator, Iterable, Mapping, Sequence
from concurrent.futures import BrokenExecutor, Future
from contextlib import suppress
from dataclasses import dataclass, field
from multiprocessing import resource_tracker as standard_tracker
from multiprocessing.connection import Connection
from typing import Any

from clpipe.base.errors import DeviceError, RequestError
from clpipe.base.memory import available_memory
from clpipe.base.processors import available_processors
from clpipe.base.system import blocked_signals
from clpipe.base.urls import listed_stamps
from clpipe.batch.chunks import ChunkExecutor, ChunkReport, WorkerDiedError
from clpipe.batch.interrupt import SIGNALS
from clpipe.batch.local_worker import Part, prepare, run_chunk
from clpipe.batch.outcome import Outcome
from clpipe.batch.spec import RunSpec
from clpipe.images.claims import MemoryClaim
from clpipe.inputs.find import Job

log = logging.getLogger(__name__)

# ms; a model of an image's CPU time, which determines the number of processes
# (docs/performance.md). The values are the time under the interpreter's lock, the total time, and
# the additional time for each megapixel.
LOCKED_MS, IMAGE_MS, MEGAPIXEL_MS = 2.0, 3.0, 25.0
# Share of a process's time; if the lock is held for longer, threads wait for it.
MAX_LOCK_SHARE = 0.5
MIN_WORK_MS = 1200  # ms; work that justifies a process. Starting a process takes 600 ms.
SMALL_MEGAPIXELS = 2.5  # megapixels; up to this size, reading and developing need not overlap
PROCESS_MEMORY = 400 << 20  # bytes per process

SHORT_CHUNK, LONG_CHUNK = 0.5, 2.0  # s; chunks grow and shrink at these times

# The run fails after so many deaths of processes in a row that have not reached a milestone.
OPENED, MADE = "opened a device", "made an image"
MAX_DEATHS = {OPENED: 3, MADE: 20}

# Python imports no modules from the working directory, and Loky restarts no large process.
ENVIRONMENT = {"PYTHONSAFEPATH": "1", "LOKY_MAX_MEMORY_LEAK_SIZE": "1e18"}
TRACKERS = {"PYTHONSAFEPATH": "1", "PYTHONWARNINGS": "ignore"}


def default_processes(images: int, claim: MemoryClaim, processors: int) -> int:
    """Return the default number of processes of a run.

    Args:
        images: the number of images.
        claim: size and memory of the first image.
        processors: the number of available processors.

    >>> small, large = MemoryClaim(512, 512, 0, 0), MemoryClaim(6000, 4000, 0, 0)
    >>> [default_processes(100_000, small, n) for n in (1, 2, 4)]
    [1, 2, 4]
    >>> default_processes(200, small, 4), default_processes(10_000, large, 64)
    (1, 1)
    """
    image_ms = IMAGE_MS + MEGAPIXEL_MS * claim.megapixels
    # The number of processors that the threads of one process keep busy.
    busy = (
        1.0
        if claim.megapixels <= SMALL_MEGAPIXELS
        else max(image_ms / LOCKED_MS * MAX_LOCK_SHARE, 1.0)
    )
    if not _has_semaphores():
        return 1
    free = available_memory()
    fit = processors if free is None else free // PROCESS_MEMORY
    return max(min(int(processors / busy), int(images * image_ms / MIN_WORK_MS), fit), 1)


def _has_semaphores() -> bool:
    """Return whether the system has the semaphores of pools. Some containers lack /dev/shm."""
    try:
        multiprocessing.get_context("spawn").Semaphore()
    except OSError:
        return False
    return True


@dataclass
class _Process:
    """A process of the run: a pool with one worker, so its death breaks only this pool.

    Args:
        part: its part of the run.
        pool: calls functions in it.
        connection: gives log records, and gets a message to stop the process. If it is closed, the
            process ends.
        listener: the thread that receives the log records.
        held: its jobs without an outcome, by stem.
        call: the last call.
        is_ready: whether it has opened its devices.
    """

    part: Part
    pool: Any
    connection: Connection
    listener: threading.Thread
    held: dict[str, Job] = field(default_factory=dict)
    call: Any = None
    is_ready: bool = False

    def close(self, kill: bool = False) -> None:
        """End it when it has done its jobs, or at once, and wait for its end."""
        self.pool.shutdown(kill_workers=kill)
        self.listener.join()
        self.connection.close()


class Processes(ChunkExecutor):
    """The processes of a run; an :class:`~clpipe.batch.sinks.Executor`.

    Args:
        spec: the run.
        count: the number of processes.
        claim: the size of the first image, which stands for all.
    """

    def __init__(self, spec: RunSpec, count: int, claim: MemoryClaim) -> None:
        super().__init__(spec, SHORT_CHUNK, LONG_CHUNK)
        self._chunks.size = 1  # the other processes wait for the first one
        self._count = count
        self._is_small = claim.megapixels <= SMALL_MEGAPIXELS
        self._processes: dict[int, _Process] = {}
        # Whether a process has compiled the kernels, which are then cached.
        self._is_compiled = False
        # Deaths of processes in a row that had not reached a milestone.
        self._deaths: Counter[str] = Counter()
        self._logged: set[str] = set()

    def run(self, jobs: Iterable[Job]) -> Generator[Outcome, None, None]:
        """Do every job, and yield outcomes as jobs finish, in any order.

        Raises:
            RequestError: no process can be started.
            DeviceError: there is no usable device, or a kernel does not compile.
            OutputError: nothing more can be written.
        """
        all_jobs = list(jobs)
        self._count = min(self._count, max(len(all_jobs), 1))
        try:
            _start_trackers()
            for number in range(self._count):
                self._start(number)
            yield from self._outcomes(all_jobs)
        finally:
            self._halt()
            for process in self._processes.values():
                process.close()
            self._remove_unfinished(all_jobs)

    def _start(self, number: int) -> None:
        """Start a process.

        Raises:
            RequestError: the system allows none. If it allows no more, the others do without.
        """
        from loky import ProcessPoolExecutor
        from loky.backend import get_context

        level = logging.getLogger("clpipe").getEffectiveLevel()
        ours, theirs = multiprocessing.Pipe()
        try:
            with blocked_signals(SIGNALS), theirs:
                pool = ProcessPoolExecutor(
                    1,
                    context=get_context("loky"),
                    initializer=prepare,
                    initargs=(theirs, level),
                    env=ENVIRONMENT,
                )
                part = Part(number, self._count, self._is_small)
                listener = threading.Thread(target=self._log, args=(ours,), daemon=True)
                process = _Process(part, pool, ours, listener)
                self._call(process, [])
                listener.start()
        except OSError as error:
            if not self._processes:
                raise RequestError(
                    f"--processes: {self._count}: no process can be started ({error.strerror}); "
                    "ask for fewer"
                ) from None
        else:
            self._processes[number] = process

    def _log(self, connection: Connection) -> None:
        """Log what a process logs until it ends. Each text appears once."""
        with suppress(EOFError, OSError):
            while True:
                record = connection.recv()
                if (text := record.getMessage()) not in self._logged:
                    self._logged.add(text)
                    logging.getLogger(record.name).handle(record)

    def _call(self, process: _Process, jobs: Sequence[Job]) -> None:
        """Give jobs to a process. It reports when it needs more, or when it has done the last."""
        limit = len(jobs) if self._is_compiled and self._chunks.jobs else 0
        stamps = listed_stamps(path for job in jobs for path in job.paths)
        try:
            call = process.pool.submit(run_chunk, self._spec, process.part, jobs, stamps, limit)
        except BrokenExecutor as error:  # it has died since its last call
            call = Future()
            call.set_exception(error)
        process.held |= {job.stem: job for job in jobs}
        process.call = call
        self._held[call] = process.held
        call.add_done_callback(self._finished.put)

    def _submit_chunks(self) -> bool:
        # The first process compiles the kernels and caches them for the others.
        processes = [*self._processes.values()]
        least = (self._spec.execution.threads or available_processors() // self._count) + 3
        for process in processes if self._is_compiled else processes[:1]:
            if process.call in self._held:
                continue
            jobs: list[Job] = []
            if not self.is_stopping:
                jobs = self._chunks.cut(self._count, least if self._is_compiled else 1)
                if not jobs and not process.held and self._chunks.suspects:
                    jobs = [self._chunks.suspects.popleft()]
            if jobs or process.held:
                self._call(process, jobs)
        return bool(self._held)

    def _result(self, future: Any, held: Mapping[str, Job]) -> ChunkReport:
        process = next(each for each in self._processes.values() if each.call is future)
        try:
            report: ChunkReport = future.result()
        except Exception as error:  # of the pool, or a defect of clpipe
            end = _end_of(error)
            self._replace(process, end)
            reason = f"killed the process that took it, 2 times; the last one {end}"
            raise WorkerDiedError(reason) from error
        process.is_ready = True
        self._is_compiled |= bool(report.outcomes)
        del self._deaths[MADE if report.outcomes else OPENED]
        for outcome in report.outcomes:
            del process.held[outcome.job.stem]
        if not report.unfinished:
            process.held.clear()  # a stopped process does not begin all jobs
        return report

    def _replace(self, process: _Process, end: str) -> None:
        """Start another process after the death of one.

        Raises:
            DeviceError: processes keep dying without doing anything.
            RequestError: no process is left, and none can be started.
        """
        number = process.part.number
        del self._processes[number]
        process.close(kill=True)
        if self.is_stopping:
            return
        log.warning("a process ended %s; its %d images go to others", end, len(process.held))
        milestone = MADE if process.is_ready else OPENED
        self._deaths[milestone] += 1
        if self._deaths[milestone] >= MAX_DEATHS[milestone]:
            raise DeviceError(
                f"--processes: {MAX_DEATHS[milestone]} processes in a row ended before they had "
                f"{milestone}, the last one {end}; --processes 1 does without"
            )
        self._start(number)

    def _halt(self) -> None:
        for process in self._processes.values():
            with suppress(OSError):  # its death is reported by its pool
                process.connection.send_bytes(b"stop")


def _start_trackers() -> None:
    """Start the two processes that remove the semaphores of pools if this process is killed.

    They may not import modules from the working directory, and remove semaphores silently.
    """
    from loky.backend import resource_tracker as loky_tracker

    before = {name: os.environ[name] for name in TRACKERS if name in os.environ}
    os.environ.update(TRACKERS)
    try:
        loky_tracker.ensure_running()
        standard_tracker.ensure_running()
    finally:
        for name in TRACKERS:
            del os.environ[name]
        os.environ.update(before)


def _end_of(error: Exception) -> str:
    """Describe how a process ended, from the error of its call.

    >>> _end_of(RuntimeError("The exit codes of the workers are {SIGKILL(-9)}"))
    'by signal 9'
    >>> _end_of(RuntimeError("The exit codes of the workers are {EXIT(1)}"))
    'with status 1'
    >>> _end_of(KeyError("a"))
    "with KeyError: 'a'"
    """
    match = re.search(r"workers are \{\w+\((-?\d+)\)", str(error))
    if not match:
        return f"with {type(error).__name__}: {error}"
    status = int(match[1])
    return f"by signal {-status}" if status < 0 else f"with status {status}"
