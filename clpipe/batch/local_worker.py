"""The functions that a process of a run on this machine calls for :class:`Processes`.

The process keeps its devices open, and a :class:`clpipe.batch.threads.Batch` that works without a
pause: a call returns while the jobs that came with it are still being done. The process ignores
signals, because the run's process tells it when to stop. It ends if the run's process has ended.
"""

import gc
import logging
import os
import queue
import threading
import time
from collections.abc import Collection, Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass
from logging.handlers import QueueHandler
from multiprocessing.connection import Connection
from multiprocessing.util import Finalize
from typing import Any, NoReturn

from clpipe.base.errors import ClpipeError
from clpipe.base.files import discard, remove_temporary_files
from clpipe.base.process_folder import process_folder
from clpipe.base.processors import available_processors
from clpipe.base.system import bind_to_processors, processor_numbers
from clpipe.base.transfers import TRANSFERS
from clpipe.base.urls import Stamp, remember_stamps
from clpipe.batch.chunks import ChunkReport
from clpipe.batch.outcome import Outcome
from clpipe.batch.spec import RunSpec, shifted
from clpipe.engine.device import Device, open_devices
from clpipe.inputs.find import Job

# The names up to PoCL 3.1, and since PoCL 4.
THREADS = ("POCL_MAX_PTHREAD_COUNT", "POCL_CPU_MAX_CU_COUNT")


@dataclass(frozen=True)
class Part:
    """One process's part of a run.

    Args:
        number: its number, from 0.
        count: the number of processes.
        is_small: whether a single thread makes the images if there is one processor, see
            :mod:`clpipe.batch.threads`.
    """

    number: int
    count: int
    is_small: bool


class _Worker:
    """The devices and the batch of this process.

    Args:
        spec: the run.
        part: this process's part of it.

    Raises:
        DeviceError: there is no usable device.
    """

    def __init__(self, spec: RunSpec, part: Part) -> None:
        processors = _take_processors(part.number, part.count)
        for name in THREADS:
            os.environ.setdefault(name, str(processors))
        execution, share = spec.execution, (part.number, part.count)
        devices: list[Device | None] = [*open_devices(execution.devices, execution.memory, share)]
        in_flight = 1 if processors == 1 and part.is_small and len(devices) <= 1 else None
        self.batch = spec.batch(devices or [None], processors, part.count, in_flight)
        self._jobs: queue.SimpleQueue[Job | None] = queue.SimpleQueue()
        self._outcomes = self.batch.run(iter(self._jobs.get, None))
        self.unfinished = 0  # jobs that will have an outcome

    def outcomes(self, jobs: Collection[Job], limit: int) -> Iterator[Outcome]:
        """Begin jobs, and yield outcomes until ``limit`` jobs are unfinished or the batch ends."""
        for job in jobs:
            self._jobs.put(job)
        self.unfinished += len(jobs)
        while self.unfinished > limit:
            outcome = next(self._outcomes, None)
            if not outcome:
                self.unfinished = 0
                break
            self.unfinished -= 1
            yield outcome

    def finish(self) -> None:
        """Finish the images in flight, and end all threads."""
        self._jobs.put(None)
        with suppress(ClpipeError):
            for _ in self._outcomes:
                pass


_workers: dict[int, _Worker] = {}  # one at most, by the number of this process
_halted = threading.Event()


def _take_processors(number: int, count: int) -> int:
    """Bind this process to its part of the processors, if it has some, and return their number."""
    numbers, available = processor_numbers(), available_processors()
    if not len(numbers) == available >= count:
        return max(available // count, 1)
    own = numbers[number * available // count : (number + 1) * available // count]
    bind_to_processors(own)
    return len(own)


def prepare(connection: Connection, level: int) -> None:
    """Prepare this process for a run.

    Args:
        connection: gets log records, and gives a message if the run stops. The other end is closed
            when the run's process ends.
        level: the lowest level that is logged.
    """
    os.dup2(2, 1)  # libraries may print; stdout is for the run's own output
    threading.Thread(target=_watch, args=(connection,), daemon=True).start()
    Finalize(None, _finish, exitpriority=0)
    gc.freeze()  # imported modules remain in use, so the collector need not visit them
    logger = logging.getLogger("clpipe")
    logger.setLevel(level)
    logger.addHandler(_Forwarder(connection))  # type: ignore[arg-type]


class _Forwarder(QueueHandler):
    """Sends log records over a connection."""

    queue: Any

    def enqueue(self, record: logging.LogRecord) -> None:
        """Send a record, unless the run's process has ended."""
        with suppress(OSError):
            self.queue.send(record)


def _finish() -> NoReturn:
    """Finish the images in flight, and end this process."""
    for worker in _workers.values():
        worker.finish()
    _leave(0)


def _leave(status: int) -> NoReturn:
    """End without waiting for other threads, and remove this process's directory."""
    if process_folder.cache_info().currsize and (folder := process_folder()):
        discard(folder)
    os._exit(status)


def _watch(connection: Connection) -> None:
    """Stop when the run does, and end this process at once when the run's process has ended."""
    with suppress(EOFError, OSError):
        while True:
            connection.recv_bytes()
            _halted.set()
            TRANSFERS.stop()
            for worker in [*_workers.values()]:
                worker.batch.stop()
    remove_temporary_files()
    _leave(1)


def run_chunk(
    spec: RunSpec,
    part: Part,
    jobs: Collection[Job],
    stamps: Mapping[str, Stamp],
    limit: int,
) -> ChunkReport:
    """Begin jobs, and report outcomes as soon as at most ``limit`` jobs are unfinished.

    Args:
        spec: the run.
        part: this process's part of it.
        jobs: the jobs.
        stamps: known stamps of their URLs.
        limit: the number of jobs that may be unfinished.
    """
    start = time.perf_counter()
    remember_stamps(stamps)
    outcomes: list[Outcome] = []
    error, unfinished = None, 0
    try:
        if not _workers:
            _workers[part.number] = _Worker(spec, part)
        worker = _workers[part.number]
        if _halted.is_set():
            worker.batch.stop()
        for outcome in worker.outcomes(jobs, limit):
            outcomes.append(shifted(outcome, 0.0, f"{part.number} "))
        unfinished = worker.unfinished
    except ClpipeError as problem:
        error = problem
    return ChunkReport(outcomes, time.perf_counter() - start, error, unfinished)
