"""Many images through the workers of a Dask cluster. The only importer of distributed.

The one who started the run holds the output folder, cuts the images into chunks, gives every worker
one at a time, and tells what became of each image; a worker runs a :class:`clpipe.batch.Batch` on
its chunk. Where a worker dies, Dask gives its chunk to another one, to which the sidecars say what
is done already: such images are reported as skipped.
"""

import asyncio
import contextlib
import os
import queue
import secrets
import threading
import time
from collections import deque
from collections.abc import Collection, Generator, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

import clpipe
from clpipe.batch import FAILED, Batch, Outcome
from clpipe.device import Device, choose_all, find_devices, open_devices
from clpipe.entrance import Entrance
from clpipe.errors import ClpipeError, ClusterError, RequestError
from clpipe.image_io import versions
from clpipe.jobs import Job
from clpipe.output_folder import remove_unfinished
from clpipe.target import Target, trouble_with

TIMEOUT = 10.0  # s, for the scheduler to answer and for its first worker
PATIENCE = 60.0  # s without any worker, as nannies and job queues start new ones
RETRIES = 2  # of a chunk that raised what nobody expected
FIRST, LARGEST = 4, 64  # images in a chunk
SHORT, LONG = 15.0, 60.0  # s; chunks that took less grow, those that took more shrink


@dataclass(frozen=True)
class Order:
    """What a worker is told of a run.

    ``folder`` is where relative paths start, ``first`` an image whose chain is compiled, ``make``
    what the worker must be; the others are those of :class:`clpipe.batch.Batch`.
    """

    entrance: Entrance
    target: Target
    selectors: tuple[str, ...]
    memory: int | None
    threads: int | None
    overwrite: bool
    trace: bool
    run: str = field(default_factory=lambda: secrets.token_hex(8))
    folder: str = field(default_factory=os.getcwd)
    make: "Make | None" = None
    first: Job | None = None


@dataclass(frozen=True)
class Make:
    """What decides about bits: the same on all workers of a run."""

    version: str
    device: str
    libraries: str


@dataclass(frozen=True)
class Report:
    """What became of a chunk; ``error`` is why the whole run cannot go on, if so."""

    outcomes: Sequence[Outcome]
    seconds: float
    error: ClpipeError | None = None


# On a worker -------------------------------------------------------------------------------------

_turn = threading.Lock()  # one Batch on a device; and the current folder is the process's
_halted: set[str] = set()
_batches: dict[str, Batch] = {}


@cache
def _opened(selectors: tuple[str, ...], memory: int | None) -> Sequence[Device | None]:
    """The devices, open from chunk to chunk; [None] is NumPy."""
    return open_devices(selectors, memory) or [None]


def close_devices() -> None:
    """Let go of the devices, on a worker."""
    _opened.cache_clear()


def make_of(selectors: Sequence[str]) -> Make:
    """What this process would be as a worker.

    Raises:
        DeviceError: there is no such device.
    """
    device = "numpy"
    if [selector.lower() for selector in selectors] != [device]:
        found = choose_all(selectors, find_devices())
        device = " and ".join(sorted({f"{d.label}, {d.lanes} lanes" for d in found}))
    libraries = {"NumPy": np.__version__, **versions()}
    return Make(clpipe.__version__, device, ", ".join(f"{k} {v}" for k, v in libraries.items()))


def look(order: Order, probe: str, size: int | None) -> Make | str:
    """See whether this process can be a worker of a run; why not, or what it would be.

    Args:
        order: the run.
        probe: the name of a file that lies in the output folder.
        size: of the first input, in bytes; None where nobody can see it.
    """
    try:
        made = make_of(order.selectors)
    except ClpipeError as error:
        return str(error)
    folder = os.path.join(order.folder, order.target.folder)
    assert order.first
    path = os.path.join(order.folder, order.first.path)
    if not os.path.isdir(order.folder):
        return f"does not see {order.folder}, where the run was started"
    if not os.path.exists(os.path.join(folder, probe)):
        return f"does not see the output folder {folder}"
    if reason := trouble_with(Path(folder)):
        return f"{folder}: {reason}"
    if size is not None and (not os.path.exists(path) or os.path.getsize(path) != size):
        return f"does not see the input {path}"
    return made


def work_off(order: Order, jobs: Sequence[Job]) -> Report:
    """Put a chunk of a run through, on a worker."""
    from distributed import get_worker

    worker = get_worker()
    key = worker.get_current_task()

    def is_abandoned() -> bool:
        task = worker.state.tasks.get(key)
        return task is None or task.state == "cancelled"

    began = time.perf_counter()
    outcomes: list[Outcome] = []
    error = None
    with _turn, contextlib.chdir(order.folder):
        try:
            made = make_of(order.selectors)
            if made != order.make:
                _same({"the others": order.make, worker.address: made})
            assert order.first
            batch = Batch(
                order.entrance,
                order.target,
                _opened(order.selectors, order.memory),
                order.entrance.first_chain([order.first]),
                order.threads or worker.state.nthreads,
                order.overwrite,
                order.trace,
            )
            _batches[order.run] = batch
            if order.run in _halted:
                batch.stop()
            since = time.time() - time.perf_counter()
            for outcome in batch.run(jobs):
                outcomes.append(_moved(outcome, since, f"{worker.address} "))
                if is_abandoned():  # who started the run has gone
                    batch.stop()
        except ClpipeError as problem:
            error = problem
        finally:
            _batches.pop(order.run, None)
    return Report(outcomes, time.perf_counter() - began, error)


def halt(run: str) -> None:
    """Let a run's images that are in flight be finished, and no more begun, on a worker."""
    _halted.add(run)
    if batch := _batches.get(run):
        batch.stop()


def _moved(outcome: Outcome, seconds: float, prefix: str = "") -> Outcome:
    """An outcome whose spans are told by another clock."""
    spans = tuple(
        replace(s, worker=prefix + s.worker, start=s.start + seconds) for s in outcome.spans
    )
    return replace(outcome, spans=spans)


# Where the run was started -----------------------------------------------------------------------


@contextlib.contextmanager
def connected(address: str, order: Order) -> Iterator["Cluster"]:
    """The cluster of a scheduler.

    Raises:
        RequestError: distributed is not installed, the scheduler does not answer, it has no
            workers, or they are of different make.
    """
    try:
        from distributed import Client
    except ImportError:
        raise RequestError("--dask: needs distributed; pip install distributed") from None
    try:
        asyncio.run(_reach(address))
        client = Client(address, timeout=TIMEOUT, name="clpipe", set_as_default=False)
    except (OSError, ValueError) as error:
        raise RequestError(
            f"--dask: no Dask scheduler answers at {address!r} within {TIMEOUT:g} s"
            f"{f' ({error})' * bool(str(error))}; expected its tcp://HOST:PORT"
        ) from None
    try:
        with contextlib.suppress(TimeoutError):
            client.wait_for_workers(1, timeout=TIMEOUT)
        if not client.nthreads():
            raise RequestError(
                f"--dask: the scheduler at {address} has no workers; start some: "
                f"dask worker {address}"
            )
        found = client.run(lambda: __import__("clpipe").__version__, on_error="return")
        for worker, version in found.items():
            if isinstance(version, BaseException):
                raise RequestError(f"--dask: worker {worker} cannot load clpipe: {version}")
        _same_in("version of clpipe", {"this machine": clpipe.__version__, **found})
        yield Cluster(client, address, order)
    finally:
        with contextlib.suppress(OSError, TimeoutError):
            client.run(close_devices, on_error="ignore")
        client.close()


async def _reach(address: str) -> None:
    """Speak to a scheduler; a Client waits without end for who listens and does not answer.

    Raises:
        OSError, ValueError: nobody answers there, or it is no address.
    """
    from distributed import Security
    from distributed.comm import connect

    security = Security().get_connection_args("client")
    comm = await asyncio.wait_for(connect(address, timeout=TIMEOUT, **security), TIMEOUT)
    await comm.close()


class Cluster:
    """A cluster's workers, as something that puts jobs through, like a Batch."""

    def __init__(self, client: Any, address: str, order: Order) -> None:
        self._client = client
        self._address = address
        self._order = order
        self._stopping = False
        self._news: queue.SimpleQueue[Any] = (
            queue.SimpleQueue()
        )  # chunks that are through; None: stop
        self._running: dict[Any, tuple[list[Job], bool]] = {}
        self._seen = time.monotonic()

    def stop(self) -> None:
        """Let no more images in; those in flight are finished. May be called by a signal."""
        self._stopping = True
        self._news.put(None)

    def run(self, jobs: Sequence[Job]) -> Generator[Outcome, None, None]:
        """Put every job through; one that fails is reported and the others go on.

        Outcomes come as chunks are finished, in any order.

        Raises:
            RequestError: workers are of different make, lack the device, or do not see the files.
            DeviceError: a kernel does not compile.
            OutputError: nothing can be written any more.
            ClusterError: the scheduler or all workers have gone.
        """
        self._look(jobs)
        return self._outcomes(jobs)

    def _look(self, jobs: Sequence[Job]) -> None:
        """See that all workers are of one make, and see the same files as this machine."""
        order = self._order
        entrance = order.entrance
        others = (job for job in jobs if not entrance.raws.takes(job.path))
        first = next(others, jobs[0])  # as Entrance.first_chain has it
        # Without what is found out when it is asked for, which is long and may be of stage files.
        order = replace(order, entrance=replace(entrance), first=first)
        size = first.path.stat().st_size if first.path.is_file() else None
        probe = order.target.folder / f".clpipe.{order.run}"
        try:
            probe.touch()
            found = self._client.run(look, order, probe.name, size, on_error="return")
        finally:
            with contextlib.suppress(OSError):
                probe.unlink()
        if not found:
            raise self._gone()
        for worker, made in found.items():
            if not isinstance(made, Make):
                raise RequestError(f"--dask: worker {worker}: {made}")
        _same(found)
        self._order = replace(order, make=next(iter(found.values())))

    def _outcomes(self, jobs: Sequence[Job]) -> Generator[Outcome, None, None]:
        chunks = _Chunks(deque(jobs))
        failure: ClpipeError | None = None
        try:
            while self._running or (chunks and not self._stopping):
                self._hand_out(chunks)
                try:
                    future = self._news.get(timeout=1)
                except queue.Empty:
                    continue
                if future is None:
                    self._halt()
                    continue
                report = self._report(future, chunks)
                chunks.took(report.seconds)
                here = time.perf_counter() - time.time()
                for outcome in report.outcomes:
                    yield _moved(outcome, here)
                if report.error:
                    failure = failure or report.error
                    self._halt()
        except GeneratorExit:
            self._finish()
            raise
        remove_unfinished(self._order.target.folder, jobs)  # by workers that died
        if failure:
            raise failure

    def _hand_out(self, chunks: "_Chunks") -> None:
        """See that there are as many chunks at work as there are workers.

        Dask chooses the worker; a chunk that is tied to one would wait for it for ever.

        Raises:
            ClusterError: there have been no workers for long, or the scheduler has gone.
        """
        try:
            workers = len(self._client.nthreads())
        except (OSError, ValueError, RuntimeError):
            raise self._gone() from None
        if workers:
            self._seen = time.monotonic()
        elif time.monotonic() - self._seen > PATIENCE:
            raise ClusterError(
                f"--dask: the scheduler at {self._address} has had no workers for {PATIENCE:g} s; "
                "what is finished is there, and the same command goes on"
            )
        while chunks.jobs and len(self._running) < workers and not self._stopping:
            self._submit(chunks.cut(workers))
        if chunks.suspects and not self._running and not self._stopping:
            self._submit([chunks.suspects.popleft()], alone=True)

    def _submit(self, chunk: list[Job], alone: bool = False) -> None:
        future = self._client.submit(work_off, self._order, chunk, pure=False, retries=RETRIES)
        self._running[future] = (chunk, alone)
        future.add_done_callback(self._news.put)

    def _report(self, future: Any, chunks: "_Chunks") -> Report:
        """What became of a chunk that is through.

        Raises:
            ClusterError: the scheduler has gone.
        """
        from distributed import KilledWorker

        chunk, alone = self._running.pop(future)
        try:
            return future.result()
        except KilledWorker as error:
            if not alone:
                chunks.suspects += chunk  # or another chunk on these workers is to blame
                return Report((), LONG)
            deaths = f"{error.allowed_failures + 1} in all, the last one {_name(error)}"
            return _failed(chunk, f"killed the worker that took it, {deaths}")
        except Exception as error:
            if future.status in ("cancelled", "lost"):
                raise self._gone() from None
            return _failed(chunk, f"on a worker: {type(error).__name__}: {error}")
        finally:
            future.release()  # or its worker's death would have it done again

    def _halt(self) -> None:
        """Let the workers finish what is in flight."""
        self._stopping = True
        self._client.run(halt, self._order.run, on_error="ignore")

    def _finish(self) -> None:
        """Wait until no worker is at it any more."""
        from distributed import wait

        self._halt()
        with self._client.as_current(), contextlib.suppress(TimeoutError):
            wait(list(self._running), timeout=LONG)

    def _gone(self) -> ClusterError:
        return ClusterError(
            f"--dask: the scheduler at {self._address} or its workers have gone; "
            "what is finished is there, and the same command goes on"
        )


@dataclass
class _Chunks:
    """What is left of the jobs, to be cut into chunks.

    They grow as long as they take little time, and get smaller again towards the end.
    ``suspects`` are jobs whose workers died: in the end each is tried with nothing beside it.

    >>> chunks = _Chunks(deque(Job(Path(str(i)), "") for i in range(100)))
    >>> chunks.took(1.0)
    >>> [len(chunks.cut(2)) for _ in range(4)], len(chunks.jobs)
    ([8, 8, 8, 8], 68)
    >>> chunks.took(100.0)
    >>> len(chunks.cut(2)), len(chunks.cut(20))
    (4, 1)
    """

    jobs: deque[Job]
    suspects: deque[Job] = field(default_factory=deque)
    size: int = FIRST

    def __bool__(self) -> bool:
        return bool(self.jobs or self.suspects)

    def cut(self, workers: int) -> list[Job]:
        """The next chunk."""
        size = max(1, min(self.size, len(self.jobs) // (2 * workers)))
        return [self.jobs.popleft() for _ in range(size)]

    def took(self, seconds: float) -> None:
        """Learn from how long a chunk took."""
        if seconds < SHORT:
            self.size = min(2 * self.size, LARGEST)
        elif seconds > LONG:
            self.size = max(self.size // 2, 1)


def _failed(chunk: Sequence[Job], reason: str) -> Report:
    return Report([Outcome(job, FAILED, error=f"{job.path}: {reason}") for job in chunk], LONG)


def _name(error: Any) -> str:
    return str(getattr(error.last_worker, "address", error.last_worker))


def _same(found: Mapping[str, Any]) -> None:
    """See that workers are of one make.

    Raises:
        RequestError: they are not.
    """
    for what in ("version", "device", "libraries"):
        _same_in(what, {worker: getattr(made, what) for worker, made in found.items()})


def _same_in(what: str, found: Mapping[str, str]) -> None:
    kinds: dict[str, list[str]] = {}
    for worker, value in found.items():
        kinds.setdefault(value, []).append(worker)
    if len(kinds) > 1:
        each = "; ".join(f"{value} on {_few(workers)}" for value, workers in kinds.items())
        raise RequestError(f"--dask: workers differ in their {what}, and so would bits: {each}")


def _few(names: Collection[str]) -> str:
    """Some names, and how many more there are.

    >>> _few("abcdef")
    'a, b, c, d and 2 more'
    """
    some = ", ".join(list(names)[:4])
    return some + f" and {len(names) - 4} more" * (len(names) > 4)
