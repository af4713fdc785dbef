"""Processes on this machine that share a run, each with its part of the processors and devices.

One Python process makes a few hundred small images a second at most, however many processors there
are, because its threads share the interpreter's lock. So a run has several processes if that pays.
This process holds the output directory and the log, distributes jobs, and collects outcomes. Each
of the others runs a :class:`clpipe.batch.threads.Batch`. If one dies, its jobs go to the others,
which see from the sidecars what is finished.
"""

import contextlib
import json
import logging
import multiprocessing
import os
import queue
import subprocess
import sys
import threading
from collections import Counter, deque
from collections.abc import Generator, Iterable, Sequence
from dataclasses import dataclass, field
from multiprocessing.connection import Connection

from clpipe.base.errors import ClpipeError, DeviceError, RequestError
from clpipe.base.memory import available_memory
from clpipe.base.processors import available_processors
from clpipe.base.system import blocked_signals, processor_numbers
from clpipe.batch.interrupt import SIGNALS
from clpipe.batch.local_worker import Seat
from clpipe.batch.outcome import FAILED, Outcome
from clpipe.batch.spec import RunSpec, shifted
from clpipe.images.claims import MemoryClaim
from clpipe.inputs.find import Job
from clpipe.outputs.folder import remove_unfinished

log = logging.getLogger(__name__)

# The model of an image's CPU time from which the number of processes follows
# (docs/performance.md): ms under the interpreter's lock, ms in all, and ms for each megapixel.
LOCKED, OF_IMAGE, OF_MEGAPIXEL = 2.0, 3.0, 25.0
SHARE = 0.5  # of a process's time that the lock may be held before threads wait for it
WORTH = 1200  # ms of work for which a process pays; to start one takes 600
SMALL = 2.5  # megapixels up to which reading and developing need not overlap
ROOM = 400 << 20  # bytes for each process

AHEAD, LEAST = 64, 12  # most jobs that a process holds, and small ones towards the end
DEATHS = 3  # of processes that held a job before it fails, or of processes that only started
FUTILE = 20  # deaths in a row without an outcome before the run fails

PROGRAM = (
    "import signal; signal.signal(signal.SIGINT, signal.SIG_IGN); "
    "signal.signal(signal.SIGTERM, signal.SIG_IGN); "
    "import json, sys; sys.path[:] = json.loads({path!r}); {start}"
)
START = "from clpipe.batch.local_worker import main; main(int(sys.argv[1]))"
THREADS = ("POCL_MAX_PTHREAD_COUNT", "POCL_CPU_MAX_CU_COUNT")  # up to PoCL 3.1, and from 4 on


def usual_processes(images: int, claim: MemoryClaim, processors: int) -> int:
    """Return how many processes a run has by default.

    Args:
        images: the number of images.
        claim: the size of the first image.
        processors: the number of available processors.

    >>> small, large = Claim(512, 512, 0, 0), Claim(6000, 4000, 0, 0)
    >>> [usual_processes(100_000, small, n) for n in (1, 2, 4)]
    [1, 2, 4]
    >>> usual_processes(200, small, 4), usual_processes(10_000, large, 64)
    (1, 1)
    """
    each = OF_IMAGE + OF_MEGAPIXEL * claim.megapixels
    # The number of processors that the threads of one process keep busy.
    fed = 1.0 if claim.megapixels <= SMALL else max(each / LOCKED * SHARE, 1.0)
    free = available_memory()
    fit = processors if free is None else free // ROOM
    return max(min(int(processors / fed), int(images * each / WORTH), fit), 1)


@dataclass
class _Process:
    """The parent's view of one process."""

    seat: Seat
    popen: "subprocess.Popen[bytes]"
    connection: Connection
    listener: threading.Thread = field(default_factory=threading.Thread)
    jobs: dict[str, Job] = field(default_factory=dict)  # that it holds, by stem
    is_alone: bool = False  # whether it is testing one suspect job
    is_ready: bool = False  # whether it has opened its devices

    def close(self) -> int:
        """Wait for its end, and return its exit status."""
        status = self.popen.wait()
        self.listener.join()
        self.connection.close()
        return status


class Processes:
    """The processes of a run; an :class:`~clpipe.batch.sinks.Executor`.

    Args:
        spec: the run.
        count: the number of processes.
        claim: the size of the first image, which stands for all.
    """

    def __init__(self, spec: RunSpec, count: int, claim: MemoryClaim) -> None:
        self._spec = spec
        self._count = count
        self._is_small = claim.megapixels <= SMALL
        self._messages: queue.SimpleQueue[tuple[_Process | None, tuple[object, ...]]]
        self._messages = queue.SimpleQueue()
        self._processes: list[_Process] = []
        self._left: deque[Job] = deque()
        self._suspects: deque[Job] = deque()  # held by a process that died; tried alone at the end
        self._deaths: Counter[str] = Counter()  # of processes that held a job, by its stem
        self._has_worked = False  # whether one has compiled the kernels, which are cached
        self._still_born = 0  # processes in a row that died before they were ready
        self._futile = 0  # processes that died since the last outcome
        self._said: set[str] = set()
        self._failure: ClpipeError | None = None
        self.is_stopping = False

    def stop(self) -> None:
        """Begin no more images, and finish those in flight. A signal handler may call it."""
        self.is_stopping = True
        self._messages.put((None, ("stop",)))

    def run(self, jobs: Iterable[Job]) -> Generator[Outcome, None, None]:
        """Do every job, and yield outcomes as jobs finish, in any order.

        Raises:
            DeviceError: there is no usable device, or a kernel does not compile.
            OutputError: nothing more can be written.
        """
        every = list(jobs)
        self._left = deque(every)
        try:
            wanted = min(self._count, max(len(every), 1))
            for number in range(wanted):
                try:
                    self._processes.append(self._start(number))
                except RequestError:
                    if not self._processes:
                        raise
                    self._count = number  # the system allows no more
                    break
            self._hand_out()
            while not self._is_finished:
                process, message = self._messages.get()
                if process is None:
                    self._tell_to_stop()
                else:
                    yield from self._heard(process, message)
                    self._hand_out()
        finally:
            self._end()
            patches = self._spec.request.patch is not None
            remove_unfinished(self._spec.where.output, every, patches)  # by processes that died
        if self._failure:
            raise self._failure

    @property
    def _is_finished(self) -> bool:
        if any(process.jobs for process in self._processes):
            return False
        if self.is_stopping:
            return not self._processes
        return not self._left and not self._suspects

    def _start(self, number: int) -> _Process:
        """Start one of the processes.

        Raises:
            RequestError: the system refuses.
        """
        every, count = processor_numbers(), self._count
        share = max(available_processors() // count, 1)
        own: tuple[int, ...] = ()
        if len(every) == available_processors() >= count:
            own = tuple(every[number * len(every) // count : (number + 1) * len(every) // count])
            share = len(own)
        in_turn = share == 1 and self._is_small
        seat = Seat(
            number, count, share, own, in_turn, logging.getLogger("clpipe").getEffectiveLevel()
        )
        limits = {name: os.environ.get(name, str(share)) for name in THREADS}
        program = PROGRAM.format(path=json.dumps(sys.path), start=START)
        try:
            ours, theirs = multiprocessing.Pipe()
            with blocked_signals(SIGNALS), theirs:
                file = theirs.fileno()
                popen = subprocess.Popen(  # noqa: S603 - this program
                    # -P: no module comes from the working directory.
                    [sys.executable, "-P", "-c", program, str(file)],
                    stdin=subprocess.DEVNULL,
                    stdout=2,  # libraries may print; stdout is for the run's own output
                    pass_fds=[file],
                    env={**os.environ, **limits},
                )
        except OSError as error:
            raise RequestError(
                f"--processes: {self._count}: no process can be started ({error.strerror}); ask "
                "for fewer"
            ) from None
        process = _Process(seat, popen, ours)
        self._send(process, self._spec, seat)
        process.listener = threading.Thread(target=self._listen, args=(process,), daemon=True)
        process.listener.start()
        return process

    def _listen(self, process: _Process) -> None:
        try:
            while True:
                self._messages.put((process, process.connection.recv()))
        except Exception:  # EOFError at its end; a damaged message counts as its end
            self._messages.put((process, ("gone",)))

    @staticmethod
    def _send(process: _Process, *message: object) -> None:
        """Send a message. If the process has died, its listener reports that."""
        with contextlib.suppress(OSError):
            process.connection.send(message)

    def _heard(self, process: _Process, message: tuple[object, ...]) -> Iterable[Outcome]:
        """Handle a message from a process, and return the outcomes that follow from it."""
        match message:
            case ("ready",):
                process.is_ready, self._still_born = True, 0
            case ("compiled",):
                self._has_worked = True
            case ("outcomes", list(outcomes)):
                self._has_worked, self._futile = True, 0
                for outcome in outcomes:
                    del process.jobs[outcome.job.stem]
                process.is_alone &= bool(process.jobs)
                return [shifted(each, 0.0, f"{process.seat.number} ") for each in outcomes]
            case ("log", int(level), str(text)):
                if text not in self._said:  # every process logs it
                    self._said.add(text)
                    log.log(level, "%s", text)
            case ("failed", ClpipeError() as error):
                self._failure = self._failure or error
                process.jobs.clear()
                self.stop()
            case ("end",) | ("gone",):
                return self._lost(process) if process in self._processes else ()
        return ()

    def _hand_out(self) -> None:
        """Give each process its next jobs, and replace processes that died.

        Raises:
            RequestError: no process can be started.
        """
        if self.is_stopping:
            return
        while len(self._processes) < self._count and self._left and self._has_worked:
            taken = {process.seat.number for process in self._processes}
            self._processes.append(self._start(min({*range(self._count)} - taken)))
        # The first process compiles the kernels and caches them for the others.
        for process in self._processes if self._has_worked else self._processes[:1]:
            if process.is_alone:
                continue
            threads = self._spec.where.threads or process.seat.threads
            least = LEAST if process.seat.in_turn else threads + 3
            most = max(min(AHEAD, len(self._left) // (2 * self._count)), least)
            if len(process.jobs) > most // 2:  # a message for one or two jobs does not pay
                continue
            count = min(most - len(process.jobs), len(self._left))
            if not count and self._suspects and not process.jobs:
                process.is_alone = True
                self._give(process, [self._suspects.popleft()])
            elif count:
                self._give(process, [self._left.popleft() for _ in range(count)])

    def _give(self, process: _Process, jobs: Sequence[Job]) -> None:
        process.jobs |= {job.stem: job for job in jobs}
        self._send(process, "jobs", jobs)

    def _lost(self, process: _Process) -> Iterable[Outcome]:
        """Handle the end of a process: others get its jobs. Returns the outcomes of failed jobs.

        Raises:
            DeviceError: processes keep dying without doing anything.
        """
        self._processes.remove(process)
        status = process.close()
        was_alone, jobs = process.is_alone, list(process.jobs.values())
        process.jobs.clear()
        if self.is_stopping:
            return []
        self._still_born += not process.is_ready
        self._futile += 1
        log.warning("a process ended %s; its %d images go to others", _ended(status), len(jobs))
        if self._still_born >= DEATHS or self._futile >= FUTILE:
            count, before = FUTILE, "made an image"
            if self._still_born >= DEATHS:
                count, before = DEATHS, "opened a device"
            raise DeviceError(
                f"--processes: {count} processes in a row ended before they had {before}, "
                f"the last one {_ended(status)}; --processes 1 does without"
            )
        for job in jobs:
            self._deaths[job.stem] += 1
        given_up = [job for job in jobs if was_alone and self._deaths[job.stem] >= DEATHS]
        self._suspects.extend(job for job in jobs if job not in given_up)
        if not self._processes:
            self._processes.append(self._start(process.seat.number))
        text = f"killed the process that took it, {DEATHS} times; the last one {_ended(status)}"
        return [Outcome(job, FAILED, error=f"{job.shown}: {text}") for job in given_up]

    def _tell_to_stop(self) -> None:
        for process in self._processes:
            self._send(process, "stop")

    def _end(self) -> None:
        """End all processes, and wait for them."""
        for process in self._processes:
            self._send(process, "stop" if process.jobs else "end")
        for process in self._processes:
            process.close()
        while not self._messages.empty():  # errors and log lines that came last
            process_, message = self._messages.get()
            if process_ and message[0] in ("failed", "log"):
                self._heard(process_, message)


def _ended(status: int) -> str:
    """Describe how a process ended, from its exit status.

    >>> _ended(-9), _ended(1)
    ('by signal 9', 'with status 1')
    """
    return f"by signal {-status}" if status < 0 else f"with status {status}"
