"""The functions that a Dask worker runs: they report its environment, and run chunks of jobs.

A worker keeps its devices open between chunks, and shares them with other workers of its machine.
"""

import secrets
import threading
import time
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np

from clpipe.base.about import __version__
from clpipe.base.digests import stamp_of
from clpipe.base.errors import ClpipeError, RequestError
from clpipe.batch.chunks import ChunkReport
from clpipe.batch.outcome import Outcome
from clpipe.batch.spec import RunSpec, shifted
from clpipe.batch.threads import Batch
from clpipe.chain.paths import resolve_paths
from clpipe.engine.device import Device, open_devices
from clpipe.engine.discovery import DeviceInfo, choose_all, find_devices
from clpipe.images.write import versions
from clpipe.inputs.find import Job
from clpipe.outputs.folder import LOCK, write_problem
from clpipe.outputs.program import program_digest


@dataclass(frozen=True)
class DaskSpec(RunSpec):
    """The description of a run that a Dask worker receives.

    Args:
        folder: the directory that relative paths start from.
        run: a unique name of the run.
        workers: the addresses of all workers.
        environment: the environment that every worker must have.
    """

    folder: Path = field(default_factory=Path.cwd)
    run: str = field(default_factory=lambda: secrets.token_hex(8))
    workers: tuple[str, ...] = ()
    environment: "WorkerEnvironment | None" = None

    def with_absolute_paths(self) -> "DaskSpec":
        """Return the description with absolute names of files, for workers in other directories."""
        folder, request_ = self.folder, self.request
        request = replace(
            request_,
            config=None if request_.config is None else resolve_paths(folder, request_.config),
            options=resolve_paths(folder, request_.options),
            image=resolve_paths(folder, request_.image),
        )
        execution = replace(self.execution, output=folder / self.execution.output)
        return replace(self, request=request, execution=execution)

    def absolute_job(self, job: Job) -> Job:
        """Return a job with absolute names of files."""
        values = resolve_paths(self.folder, job.values)
        first, *others = (self.folder / path for path in job.paths)
        return replace(
            job, path=first, subframes=tuple(others), values=values, as_written=job.input
        )


def as_written(outcome: Outcome) -> Outcome:
    """Return the outcome of an anchored job, with its path as the user wrote it."""
    job = outcome.job
    return replace(
        outcome,
        job=replace(job, path=Path(job.input)),
        error=outcome.error.replace(str(job.path), job.input),
    )


@dataclass(frozen=True)
class WorkerEnvironment:
    """The software and devices that a picture's bytes depend on; equal on all workers of a run."""

    version: str
    program: str
    device: str
    libraries: str


_one_chunk = threading.Lock()  # lets one chunk at a time use this worker's devices

_halted: set[str] = set()

_batches: dict[str, Batch] = {}  # batches by the name of the run


@lru_cache(maxsize=1)  # one entry, because the share changes when workers come and go
def _devices(
    selectors: tuple[str, ...], memory: int | None, share: tuple[int, int]
) -> Sequence[Device | None]:
    """Return the devices, which stay open between chunks. [None] is NumPy."""
    return open_devices(selectors, memory, share) or [None]


def share_on_machine(worker: str, workers: Collection[str]) -> tuple[int, int]:
    """Return a worker's number on its machine, from 0, and the number of workers there.

    >>> share_on_machine("tcp://b:2", ["tcp://b:1", "tcp://a:1", "tcp://b:3", "tcp://b:2"])
    (1, 3)
    """
    scheme_and_host, _, port = worker.rpartition(":")
    if not port.isdecimal():  # the address is within one process
        return 0, 1
    neighbours = sorted({worker, *(w for w in workers if w.rpartition(":")[0] == scheme_and_host)})
    return neighbours.index(worker), len(neighbours)


def close_devices() -> None:
    """Close the devices of a worker."""
    _devices.cache_clear()


def worker_environment(selectors: Sequence[str]) -> WorkerEnvironment:
    """Return the environment of this process as a worker with these devices.

    Raises:
        DeviceError: there is no such device.
    """
    device = "numpy"
    if [selector.lower() for selector in selectors] != [device]:
        chosen = choose_all(selectors, find_devices())
        device = " and ".join(sorted({device_text(info) for info in chosen}))
    libraries = {"NumPy": np.__version__, **versions()}
    return WorkerEnvironment(
        __version__,
        program_digest()[:12],
        device,
        ", ".join(f"{k} {v}" for k, v in libraries.items()),
    )


def device_text(info: DeviceInfo) -> str:
    """Describe everything about a device that bits may depend on."""
    platform = info.handle.platform.version.strip()
    target = f" for {info.target.name}" if info.target.name else ""
    return f"{info.label}, driver {info.driver}, {platform}, {info.lanes} lanes{target}"


def probe_worker(spec: DaskSpec, probe: str, size: int | None) -> WorkerEnvironment | str:
    """Return the environment of this process, or the reason why it cannot work for a run.

    Args:
        spec: the run.
        probe: the name of a file in the output directory.
        size: the size of the first input, in bytes. None if the client cannot see it.
    """
    try:
        environment = worker_environment(spec.execution.devices)
    except ClpipeError as error:
        return str(error)
    path, output = spec.first.path, spec.execution.output
    if not (output / probe).exists():
        return f"does not see the output directory {output}"
    if reason := write_problem(output):
        return f"{output}: {reason}"
    if size is not None and stamp_of(path)[0] != size:
        return f"does not see the input {path}"
    return environment


def run_chunk(spec: DaskSpec, jobs: Sequence[Job]) -> ChunkReport:
    """Do a chunk of a run, on a worker."""
    from distributed import get_worker

    worker = get_worker()
    key = worker.get_current_task()

    def is_abandoned() -> bool:
        task = worker.state.tasks.get(key)
        return task is None or task.state == "cancelled"

    start = time.perf_counter()
    outcomes: list[Outcome] = []
    error = None
    with _one_chunk:
        try:
            environment = worker_environment(spec.execution.devices)
            if environment != spec.environment:
                check_same_environment(
                    {"the others": spec.environment, worker.address: environment}
                )
            if not (spec.execution.output / LOCK).exists():
                raise RequestError(
                    f"--dask: worker {worker.address} does not see the output directory "
                    f"{spec.execution.output}"
                )
            share = share_on_machine(worker.address, spec.workers)
            devices = _devices(spec.execution.devices, spec.execution.memory, share)
            batch = _batches[spec.run] = spec.batch(devices, worker.state.nthreads, share[1])
            if spec.run in _halted:
                batch.stop()
            clock_offset = time.time() - time.perf_counter()
            for outcome in batch.run(jobs):
                outcomes.append(shifted(outcome, clock_offset, f"{worker.address} "))
                if is_abandoned():  # the process that started the run has abandoned it
                    batch.stop()
        except ClpipeError as problem:
            error = problem
        finally:
            _batches.pop(spec.run, None)
    return ChunkReport(outcomes, time.perf_counter() - start, error)


def halt(run: str) -> None:
    """Begin no more images of a run on this worker, and finish those in flight."""
    _halted.add(run)
    if batch := _batches.get(run):
        batch.stop()


def check_same_environment(environments: Mapping[str, Any]) -> None:
    """Check that workers have the same environment.

    Raises:
        RequestError: they differ.
    """
    for aspect in ("version", "device", "libraries"):
        check_same(aspect, {worker: getattr(e, aspect) for worker, e in environments.items()})


def check_same(aspect: str, values: Mapping[str, str]) -> None:
    """Check that a value is the same on all workers.

    Args:
        aspect: the name of the value, for the message.
        values: the value of each worker.

    Raises:
        RequestError: they differ.
    """
    workers: dict[str, list[str]] = {}
    for worker, value in values.items():
        workers.setdefault(value, []).append(worker)
    if len(workers) > 1:
        each = "; ".join(f"{value} on {_first_names(names)}" for value, names in workers.items())
        raise RequestError(
            f"--dask: workers differ in their {aspect}, so their pictures may differ: {each}"
        )


def _first_names(names: Collection[str]) -> str:
    """List the first names, and the number of others.

    >>> _first_names("abcdef")
    'a, b, c, d and 2 more'
    """
    some = ", ".join(list(names)[:4])
    return some + f" and {len(names) - 4} more" * (len(names) > 4)
