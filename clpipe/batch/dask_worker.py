"""What a Dask worker does of a run: it says what it is, and runs chunks of jobs.

A worker keeps its devices open from chunk to chunk.
"""

import contextlib
import os
import secrets
import threading
import time
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

from clpipe.base.about import __version__
from clpipe.base.errors import ClpipeError, RequestError
from clpipe.batch.outcome import Outcome
from clpipe.batch.threads import Batch
from clpipe.batch.work import ImageWorker
from clpipe.chain.request import Request
from clpipe.engine.device import Device, open_devices
from clpipe.engine.discovery import choose_all, find_devices
from clpipe.images.write import versions
from clpipe.inputs.find import Job
from clpipe.inputs.loader import ImageLoader
from clpipe.outputs.folder import write_problem
from clpipe.outputs.writer import OutputWriter


@dataclass(frozen=True)
class RunSpec:
    """A run, as it is sent to a worker.

    Args:
        request: what is asked for.
        output: the output folder.
        selectors: of the devices, as ``--device`` has them.
        memory: of a device, in bytes; None is what is free.
        threads: as for :class:`clpipe.batch.threads.Batch`.
        overwrite, verify, trace: as for :class:`clpipe.batch.work.ImageWorker`.
        run: a name that no other run has.
        folder: where relative paths start.
        environment: what every worker must be.
        first: the job whose chain is compiled early.
    """

    request: Request
    output: Path
    selectors: tuple[str, ...]
    memory: int | None
    threads: int | None
    overwrite: bool
    verify: bool
    trace: bool
    run: str = field(default_factory=lambda: secrets.token_hex(8))
    folder: str = field(default_factory=os.getcwd)
    environment: "WorkerEnvironment | None" = None
    first: Job | None = None


@dataclass(frozen=True)
class WorkerEnvironment:
    """What the bytes of a picture depend on, the same on all workers of a run."""

    version: str
    device: str
    libraries: str


@dataclass(frozen=True)
class ChunkReport:
    """What became of a chunk, and the error because of which the run cannot go on, if any."""

    outcomes: Sequence[Outcome]
    seconds: float
    error: ClpipeError | None = None


_one_chunk = threading.Lock()  # devices are for one thread, and the current folder is the process's

_halted: set[str] = set()

_batches: dict[str, Batch] = {}  # by the name of the run


@cache
def _devices(selectors: tuple[str, ...], memory: int | None) -> Sequence[Device | None]:
    """The devices, open from chunk to chunk; [None] is NumPy."""
    return open_devices(selectors, memory) or [None]


def close_devices() -> None:
    """Let go of the devices, on a worker."""
    _devices.cache_clear()


def worker_environment(selectors: Sequence[str]) -> WorkerEnvironment:
    """The environment of this process, as a worker with these devices.

    Raises:
        DeviceError: there is no such device.
    """
    device = "numpy"
    if [selector.lower() for selector in selectors] != [device]:
        chosen = choose_all(selectors, find_devices())
        device = " and ".join(sorted({f"{d.label}, {d.lanes} lanes" for d in chosen}))
    libraries = {"NumPy": np.__version__, **versions()}
    return WorkerEnvironment(
        __version__, device, ", ".join(f"{k} {v}" for k, v in libraries.items())
    )


def probe_worker(spec: RunSpec, probe: str, size: int | None) -> WorkerEnvironment | str:
    """The environment of this process; where it cannot be a worker of a run, the reason.

    Args:
        spec: the run.
        probe: the name of a file that lies in the output folder.
        size: of the first input, in bytes; None where nobody can see it.
    """
    try:
        environment = worker_environment(spec.selectors)
    except ClpipeError as error:
        return str(error)
    folder = os.path.join(spec.folder, spec.output)
    assert spec.first
    path = os.path.join(spec.folder, spec.first.path)
    if not os.path.isdir(spec.folder):
        return f"does not see {spec.folder}, where the run was started"
    if not os.path.exists(os.path.join(folder, probe)):
        return f"does not see the output folder {folder}"
    if reason := write_problem(Path(folder)):
        return f"{folder}: {reason}"
    if size is not None and (not os.path.exists(path) or os.path.getsize(path) != size):
        return f"does not see the input {path}"
    return environment


def run_chunk(spec: RunSpec, jobs: Sequence[Job]) -> ChunkReport:
    """Do a chunk of a run, on a worker."""
    from distributed import get_worker

    worker = get_worker()
    key = worker.get_current_task()

    def is_abandoned() -> bool:
        task = worker.state.tasks.get(key)
        return task is None or task.state == "cancelled"

    began = time.perf_counter()
    outcomes: list[Outcome] = []
    error = None
    with _one_chunk, contextlib.chdir(spec.folder):
        try:
            environment = worker_environment(spec.selectors)
            if environment != spec.environment:
                check_same_environment(
                    {"the others": spec.environment, worker.address: environment}
                )
            batch = _batches[spec.run] = _batch(spec, worker.state.nthreads)
            if spec.run in _halted:
                batch.stop()
            since = time.time() - time.perf_counter()
            for outcome in batch.run(jobs):
                outcomes.append(shifted(outcome, since, f"{worker.address} "))
                if is_abandoned():  # by the process that started the run
                    batch.stop()
        except ClpipeError as problem:
            error = problem
        finally:
            _batches.pop(spec.run, None)
    return ChunkReport(outcomes, time.perf_counter() - began, error)


def _batch(spec: RunSpec, threads: int) -> Batch:
    """The batch of one chunk; ``threads`` where the run does not say how many."""
    assert spec.first
    loader, writer = ImageLoader(spec.request), OutputWriter(spec.output, spec.request)
    chain = loader.first_chain([spec.first])
    worker = ImageWorker(loader, writer, chain, spec.overwrite, spec.verify, spec.trace)
    return Batch(worker, _devices(spec.selectors, spec.memory), spec.threads or threads)


def halt(run: str) -> None:
    """Let a run's images in flight be finished and no more be begun, on a worker."""
    _halted.add(run)
    if batch := _batches.get(run):
        batch.stop()


def shifted(outcome: Outcome, seconds: float, prefix: str = "") -> Outcome:
    """An outcome with the times of another clock, and a prefix before the names of threads."""
    spans = tuple(
        replace(s, worker=prefix + s.worker, start=s.start + seconds) for s in outcome.spans
    )
    return replace(outcome, spans=spans)


def check_same_environment(environments: Mapping[str, Any]) -> None:
    """See that workers have the same environment.

    Raises:
        RequestError: they have not.
    """
    for what in ("version", "device", "libraries"):
        check_same(what, {worker: getattr(e, what) for worker, e in environments.items()})


def check_same(what: str, values: Mapping[str, str]) -> None:
    """See that workers have the same value of something.

    Args:
        what: what it is called, for the message.
        values: of each worker.

    Raises:
        RequestError: they have not.
    """
    workers: dict[str, list[str]] = {}
    for worker, value in values.items():
        workers.setdefault(value, []).append(worker)
    if len(workers) > 1:
        each = "; ".join(f"{value} on {_some(names)}" for value, names in workers.items())
        raise RequestError(f"--dask: workers differ in their {what}, and so would bits: {each}")


def _some(names: Collection[str]) -> str:
    """The first names, and how many more there are.

    >>> _some("abcdef")
    'a, b, c, d and 2 more'
    """
    some = ", ".join(list(names)[:4])
    return some + f" and {len(names) - 4} more" * (len(names) > 4)
