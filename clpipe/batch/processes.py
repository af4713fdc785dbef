"""Processes on this machine that share a run, each with its part of the processors and devices.

One Python process computes at most a few hundred small images per second on any number of
processors, because its threads share the interpreter's lock. A run therefore has several processes
if they save time. This process holds the output directory and the log, distributes jobs, and
collects outcomes. Each of the others runs a :class:`clpipe.batch.threads.Batch`. If one dies, the
others get its jobs. Sidecars show which of these are finished.
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
from clpipe.base.urls import listed_stamps
from clpipe.batch.interrupt import SIGNALS
from clpipe.batch.local_worker import ProcessConfig
from clpipe.batch.outcome import FAILED, Outcome
from clpipe.batch.spec import RunSpec, shifted
from clpipe.images.claims import MemoryClaim
from clpipe.inputs.find import Job
from clpipe.outputs.folder import remove_unfinished

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

# The most jobs that a process holds, usually and near the end of the run.
MAX_QUEUED, MIN_QUEUED = 64, 12
# After this many deaths of processes, their job fails. If they die while starting, the run fails.
MAX_DEATHS = 3
MAX_FRUITLESS = 20  # the run fails after this many deaths in a row without an outcome

PROGRAM = (
    "import signal; signal.signal(signal.SIGINT, signal.SIG_IGN); "
    "signal.signal(signal.SIGTERM, signal.SIG_IGN); "
    "import json, sys; sys.path[:] = json.loads({path!r}); {start}"
)
START = "from clpipe.batch.local_worker import main; main(int(sys.argv[1]))"
# The name up to PoCL 3.1, and the name since PoCL 4.
THREADS = (
    "POCL_MAX_PTHREAD_COUNT",
    "POCL_CPU_MAX_CU_COUNT",
)


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
    free = available_memory()
    fit = processors if free is None else free // PROCESS_MEMORY
    return max(min(int(processors / busy), int(images * image_ms / MIN_WORK_MS), fit), 1)


@dataclass
class _Process:
    """The parent's view of one process."""

    config: ProcessConfig
    popen: "subprocess.Popen[bytes]"
    connection: Connection
    listener: threading.Thread = field(default_factory=threading.Thread)
    jobs: dict[str, Job] = field(default_factory=dict)  # jobs of the process, by stem
    is_alone: bool = False  # whether the process is testing one suspect job
    is_ready: bool = False  # whether the process has opened its devices

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
        self._is_small = claim.megapixels <= SMALL_MEGAPIXELS
        self._messages: queue.SimpleQueue[tuple[_Process | None, tuple[object, ...]]]
        self._messages = queue.SimpleQueue()
        self._processes: list[_Process] = []
        self._remaining: deque[Job] = deque()
        # Jobs of processes that died; each is tried separately at the end.
        self._suspects: deque[Job] = deque()
        # For each job's stem, the deaths of processes that held the job.
        self._deaths: Counter[str] = Counter()
        # Whether a process has compiled the kernels, which are then cached.
        self._is_compiled = False
        self._early_deaths = 0  # processes in a row that died before they were ready
        self._fruitless_deaths = 0  # processes that died since the last outcome
        self._logged: set[str] = set()
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
        all_jobs = list(jobs)
        self._remaining = deque(all_jobs)
        try:
            count = min(self._count, max(len(all_jobs), 1))
            for number in range(count):
                try:
                    self._processes.append(self._start(number))
                except RequestError:
                    if not self._processes:
                        raise
                    self._count = number  # the system allows no more processes
                    break
            self._distribute_jobs()
            while not self._is_finished:
                process, message = self._messages.get()
                if process is None:
                    self._stop_processes()
                else:
                    yield from self._handle(process, message)
                    self._distribute_jobs()
        finally:
            self._end()
            patches = self._spec.request.patch is not None
            # Remove the unfinished files of processes that died.
            remove_unfinished(self._spec.execution.output, all_jobs, patches)
        if self._failure:
            raise self._failure

    @property
    def _is_finished(self) -> bool:
        if any(process.jobs for process in self._processes):
            return False
        if self.is_stopping:
            return not self._processes
        return not self._remaining and not self._suspects

    def _start(self, number: int) -> _Process:
        """Start one of the processes.

        Raises:
            RequestError: the system refuses.
        """
        available, count = processor_numbers(), self._count
        share = max(available_processors() // count, 1)
        own_processors: tuple[int, ...] = ()
        if len(available) == available_processors() >= count:
            own_processors = tuple(
                available[number * len(available) // count : (number + 1) * len(available) // count]
            )
            share = len(own_processors)
        sequential = share == 1 and self._is_small
        config = ProcessConfig(
            number,
            count,
            share,
            own_processors,
            sequential,
            logging.getLogger("clpipe").getEffectiveLevel(),
        )
        limits = {name: os.environ.get(name, str(share)) for name in THREADS}
        program = PROGRAM.format(path=json.dumps(sys.path), start=START)
        try:
            parent_end, child_end = multiprocessing.Pipe()
            with blocked_signals(SIGNALS), child_end:
                file = child_end.fileno()
                popen = subprocess.Popen(  # noqa: S603 - this program
                    # -P: do not import modules from the working directory.
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
        process = _Process(config, popen, parent_end)
        self._send(process, self._spec, config)
        process.listener = threading.Thread(target=self._listen, args=(process,), daemon=True)
        process.listener.start()
        return process

    def _listen(self, process: _Process) -> None:
        try:
            while True:
                self._messages.put((process, process.connection.recv()))
        except Exception:  # EOFError marks the end; a damaged message counts as the end
            self._messages.put((process, ("gone",)))

    @staticmethod
    def _send(process: _Process, *message: object) -> None:
        """Send a message. If the process has died, its listener reports that."""
        with contextlib.suppress(OSError):
            process.connection.send(message)

    def _handle(self, process: _Process, message: tuple[object, ...]) -> Iterable[Outcome]:
        """Handle a message from a process, and return the outcomes that follow from it."""
        match message:
            case ("ready",):
                process.is_ready, self._early_deaths = True, 0
            case ("compiled",):
                self._is_compiled = True
            case ("outcomes", list(outcomes)):
                self._is_compiled, self._fruitless_deaths = True, 0
                for outcome in outcomes:
                    del process.jobs[outcome.job.stem]
                process.is_alone &= bool(process.jobs)
                return [shifted(outcome, 0.0, f"{process.config.number} ") for outcome in outcomes]
            case ("log", int(level), str(text)):
                if text not in self._logged:  # every process logs the same text
                    self._logged.add(text)
                    log.log(level, "%s", text)
            case ("failed", ClpipeError() as error):
                self._failure = self._failure or error
                process.jobs.clear()
                self.stop()
            case ("end",) | ("gone",):
                return self._handle_death(process) if process in self._processes else ()
        return ()

    def _distribute_jobs(self) -> None:
        """Give each process its next jobs, and replace processes that died.

        Raises:
            RequestError: no process can be started.
        """
        if self.is_stopping:
            return
        while len(self._processes) < self._count and self._remaining and self._is_compiled:
            taken = {process.config.number for process in self._processes}
            self._processes.append(self._start(min({*range(self._count)} - taken)))
        # The first process compiles the kernels and caches them for the others.
        for process in self._processes if self._is_compiled else self._processes[:1]:
            if process.is_alone:
                continue
            threads = self._spec.execution.threads or process.config.threads
            min_queued = MIN_QUEUED if process.config.sequential else threads + 3
            max_queued = max(min(MAX_QUEUED, len(self._remaining) // (2 * self._count)), min_queued)
            # A message for only one or two jobs is not worthwhile.
            if len(process.jobs) > max_queued // 2:
                continue
            count = min(max_queued - len(process.jobs), len(self._remaining))
            if not count and self._suspects and not process.jobs:
                process.is_alone = True
                self._give(process, [self._suspects.popleft()])
            elif count:
                self._give(process, [self._remaining.popleft() for _ in range(count)])

    def _give(self, process: _Process, jobs: Sequence[Job]) -> None:
        process.jobs |= {job.stem: job for job in jobs}
        self._send(process, "jobs", jobs, listed_stamps(path for job in jobs for path in job.paths))

    def _handle_death(self, process: _Process) -> Iterable[Outcome]:
        """Handle the end of a process: others get its jobs. Returns the outcomes of failed jobs.

        Raises:
            DeviceError: processes keep dying without doing anything.
        """
        self._processes.remove(process)
        status = process.close()
        was_testing_one, jobs = process.is_alone, list(process.jobs.values())
        process.jobs.clear()
        if self.is_stopping:
            return []
        self._early_deaths += not process.is_ready
        self._fruitless_deaths += 1
        log.warning("a process ended %s; its %d images go to others", _exit_text(status), len(jobs))
        if self._early_deaths >= MAX_DEATHS or self._fruitless_deaths >= MAX_FRUITLESS:
            count, milestone = MAX_FRUITLESS, "made an image"
            if self._early_deaths >= MAX_DEATHS:
                count, milestone = MAX_DEATHS, "opened a device"
            raise DeviceError(
                f"--processes: {count} processes in a row ended before they had {milestone}, "
                f"the last one {_exit_text(status)}; --processes 1 does without"
            )
        for job in jobs:
            self._deaths[job.stem] += 1
        given_up = [job for job in jobs if was_testing_one and self._deaths[job.stem] >= MAX_DEATHS]
        self._suspects.extend(job for job in jobs if job not in given_up)
        if not self._processes:
            self._processes.append(self._start(process.config.number))
        end = _exit_text(status)
        text = f"killed the process that took it, {MAX_DEATHS} times; the last one {end}"
        return [
            Outcome(job, FAILED, error=f"{job.display_name}: {text}", error_class="unexpected")
            for job in given_up
        ]

    def _stop_processes(self) -> None:
        for process in self._processes:
            self._send(process, "stop")

    def _end(self) -> None:
        """End all processes, and wait for them."""
        for process in self._processes:
            self._send(process, "stop" if process.jobs else "end")
        for process in self._processes:
            process.close()
        while not self._messages.empty():  # the last errors and log lines
            process_, message = self._messages.get()
            if process_ and message[0] in ("failed", "log"):
                self._handle(process_, message)


def _exit_text(status: int) -> str:
    """Describe how a process ended, from its exit status.

    >>> _exit_text(-9), _exit_text(1)
    ('by signal 9', 'with status 1')
    """
    return f"by signal {-status}" if status < 0 else f"with status {status}"
