"""What a process of a run on this machine does: its share of the images, as they come to it.

Its standard input brings what :class:`clpipe.batch.processes.Processes` sends, its standard output
takes what became of it. It ends when there is no more to do, and at once when the run's process is
gone. Signals are for that process, which says when to stop.
"""

import gc
import logging
import os
import queue
import sys
import threading
import time
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any, NoReturn

from clpipe.base.errors import ClpipeError
from clpipe.base.files import discard, remove_temporary_files
from clpipe.base.process_folder import process_folder
from clpipe.base.system import stay_on
from clpipe.batch.outcome import Outcome
from clpipe.batch.pipes import Pipe
from clpipe.batch.spec import RunSpec
from clpipe.batch.threads import Batch, Jobs
from clpipe.engine.device import Device, open_devices

SOON = 0.005  # s for which outcomes are collected, as each message has its price


@dataclass(frozen=True)
class Seat:
    """Which of a run's processes one is.

    Args:
        number: from 0 on.
        of: how many there are.
        threads: that decode, and that encode, where the run does not say how many.
        processors: on which it stays; () is wherever the system puts it.
        in_turn: whether one thread does all of one image after the other.
        level: of what is logged.
    """

    number: int
    of: int
    threads: int
    processors: tuple[int, ...] = ()
    in_turn: bool = False
    level: int = logging.INFO


def main() -> None:
    """Do what standard input says."""
    pipe = _PipeToRun(sys.stdin.buffer, os.fdopen(os.dup(1), "wb"))
    os.dup2(2, 1)  # what libraries print is no message
    gc.freeze()  # what is imported stays: looking through it again and again takes time
    spec, seat = pipe.receive()
    if seat.processors:
        stay_on(seat.processors)
    logger = logging.getLogger("clpipe")
    logger.setLevel(seat.level)
    logger.addHandler(_Forwarder(pipe))
    try:
        _work(pipe, spec, seat)
    except ClpipeError as error:
        pipe.send("failed", error)
    pipe.send("end")
    _leave(0)


def _leave(status: int) -> NoReturn:
    """End, whatever other threads wait for, and leave no folder behind."""
    if process_folder.cache_info().currsize and (folder := process_folder()):
        discard(folder)
    os._exit(status)


class _PipeToRun(Pipe):
    """The pipe to the run's process. Ends this process silently if the run's process is gone."""

    def send(self, *message: Any) -> None:
        """Send values."""
        try:
            super().send(*message)
        except OSError:
            _abandon()

    def receive(self) -> Any:
        """Return the next message."""
        try:
            return super().receive()
        except EOFError:
            _abandon()


def _abandon() -> NoReturn:
    """End this process without finishing its images."""
    remove_temporary_files()
    _leave(1)


def _work(pipe: Pipe, spec: RunSpec, seat: Seat) -> None:
    """Do the jobs that come, and send what became of them.

    Raises:
        ClpipeError: the process cannot go on.
    """
    where = spec.where
    share = seat.number, seat.of
    devices: list[Device | None] = [*open_devices(where.devices, where.memory, share)] or [None]
    pipe.send("ready")
    jobs: Jobs = queue.SimpleQueue()
    in_flight = 1 if seat.in_turn and len(devices) == 1 else None
    batch = spec.batch(
        devices, seat.threads, seat.of, in_flight, compiled=lambda: pipe.send("compiled")
    )
    threading.Thread(target=_listen, args=(pipe, jobs, batch), daemon=True).start()
    finished: queue.SimpleQueue[Outcome | None] = queue.SimpleQueue()
    teller = threading.Thread(target=_tell, args=(pipe, finished))
    teller.start()
    try:
        for outcome in batch.run(jobs):
            finished.put(outcome)
    finally:
        finished.put(None)
        teller.join()


def _listen(pipe: Pipe, jobs: Jobs, batch: Batch) -> None:
    """Take jobs in, until it is said that there are no more."""
    while True:
        what, *values = pipe.receive()
        for job in values[0] if what == "jobs" else ():
            jobs.put(job)
        if what == "stop":
            batch.stop()
        if what != "jobs":
            jobs.put(None)


def _tell(pipe: Pipe, finished: "queue.SimpleQueue[Outcome | None]") -> None:
    """Send outcomes, several at a time."""
    for first in iter(finished.get, None):
        time.sleep(SOON)
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
    """Sends what is logged to the run's process, which prints it."""

    def __init__(self, pipe: Pipe) -> None:
        super().__init__()
        self._pipe = pipe

    def emit(self, record: logging.LogRecord) -> None:
        self._pipe.send("log", record.levelno, record.getMessage())
