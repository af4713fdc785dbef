"""The main function of a process that does a part of a run on this machine.

It receives jobs from :class:`clpipe.batch.processes.Processes` over a connection, and sends
outcomes back. It ends when there are no more jobs, and immediately if the run's process has ended.
It ignores signals, because the run's process tells it when to stop.
"""

import gc
import logging
import os
import queue
import threading
import time
from collections.abc import Iterator
from dataclasses import dataclass
from multiprocessing.connection import Connection
from typing import Any, NoReturn

from clpipe.base.errors import ClpipeError
from clpipe.base.files import discard, remove_temporary_files
from clpipe.base.process_folder import process_folder
from clpipe.base.system import bind_to_processors
from clpipe.base.transfers import TRANSFERS
from clpipe.base.urls import remember_stamps
from clpipe.batch.downloads import Jobs
from clpipe.batch.outcome import Outcome
from clpipe.batch.spec import RunSpec
from clpipe.batch.threads import Batch
from clpipe.engine.device import Device, open_devices

COLLECT_SECONDS = 0.005  # s; outcomes of this time are sent in one message


@dataclass(frozen=True)
class ProcessConfig:
    """One process's part of a run.

    Args:
        number: its number, from 0.
        count: the number of processes.
        threads: the number of threads if the run does not set it.
        processors: the processors that it is bound to. () binds it to none.
        sequential: whether a single thread makes the images, see :mod:`clpipe.batch.threads`.
        level: the lowest level that is logged.
    """

    number: int
    count: int
    threads: int
    processors: tuple[int, ...] = ()
    sequential: bool = False
    level: int = logging.INFO


def main(file: int) -> None:
    """Work for the run at the other end of a connection, given by its file descriptor."""
    pipe = _PipeToRun(Connection(file))
    gc.freeze()  # imported modules remain in use, so the collector need not visit them
    spec, config = pipe.receive()
    if config.processors:
        bind_to_processors(config.processors)
    logger = logging.getLogger("clpipe")
    logger.setLevel(config.level)
    logger.addHandler(_Forwarder(pipe))
    try:
        _work(pipe, spec, config)
    except ClpipeError as error:
        pipe.send("failed", error)
    pipe.send("end")
    _leave(0)


def _leave(status: int) -> NoReturn:
    """End without waiting for other threads, and remove this process's directory."""
    if process_folder.cache_info().currsize and (folder := process_folder()):
        discard(folder)
    os._exit(status)


class _PipeToRun:
    """The connection to the run's process. Ends this process silently when that one has ended."""

    def __init__(self, connection: Connection) -> None:
        self._connection = connection
        self._sending = threading.Lock()  # lets one thread send at a time

    def send(self, *message: Any) -> None:
        """Send values. Any thread may call it."""
        try:
            with self._sending:
                self._connection.send(message)
        except OSError:
            _exit_at_once()

    def receive(self) -> Any:
        """Return the next message. Only one thread may call it at a time."""
        try:
            return self._connection.recv()
        except (EOFError, OSError):
            _exit_at_once()


def _exit_at_once() -> NoReturn:
    """End this process without finishing its images."""
    remove_temporary_files()
    _leave(1)


def _work(pipe: _PipeToRun, spec: RunSpec, config: ProcessConfig) -> None:
    """Do the jobs that arrive, and send their outcomes.

    Raises:
        ClpipeError: the process cannot continue.
    """
    execution = spec.execution
    share = config.number, config.count
    devices: list[Device | None] = [*open_devices(execution.devices, execution.memory, share)] or [
        None
    ]
    pipe.send("ready")
    jobs: Jobs = queue.SimpleQueue()
    in_flight = 1 if config.sequential and len(devices) == 1 else None
    batch = spec.batch(
        devices, config.threads, config.count, in_flight, compiled=lambda: pipe.send("compiled")
    )
    threading.Thread(target=_listen, args=(pipe, jobs, batch), daemon=True).start()
    finished: queue.SimpleQueue[Outcome | None] = queue.SimpleQueue()
    sender = threading.Thread(target=_send_outcomes, args=(pipe, finished))
    sender.start()
    try:
        for outcome in batch.run(jobs):
            finished.put(outcome)
    finally:
        finished.put(None)
        sender.join()


def _listen(pipe: _PipeToRun, jobs: Jobs, batch: Batch) -> None:
    """Receive jobs until the end or a stop."""
    while True:
        kind, *values = pipe.receive()
        if kind == "jobs":
            remember_stamps(values[1])
            for job in values[0]:
                jobs.put(job)
        if kind == "stop":
            TRANSFERS.stop()
            batch.stop()
        if kind != "jobs":
            jobs.put(None)


def _send_outcomes(pipe: _PipeToRun, finished: "queue.SimpleQueue[Outcome | None]") -> None:
    """Send outcomes, several in each message."""
    for first in iter(finished.get, None):
        time.sleep(COLLECT_SECONDS)
        outcomes = [first, *_waiting(finished)]
        pipe.send("outcomes", [each for each in outcomes if each])
        if None in outcomes:
            return


def _waiting(finished: "queue.SimpleQueue[Outcome | None]") -> Iterator[Outcome | None]:
    while True:
        try:
            yield finished.get_nowait()
        except queue.Empty:
            return


class _Forwarder(logging.Handler):
    """Sends log records to the run's process, which prints them."""

    def __init__(self, pipe: _PipeToRun) -> None:
        super().__init__()
        self._pipe = pipe

    def emit(self, record: logging.LogRecord) -> None:
        self._pipe.send("log", record.levelno, record.getMessage())
