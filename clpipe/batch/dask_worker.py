"""TODO."""

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
from clpipe.engine.device import Device, open_devices
from clpipe.engine.discovery import choose_all, find_devices
from clpipe.images.write import versions
from clpipe.inputs.find import Job
from clpipe.inputs.loader import ImageLoader
from clpipe.outputs.folder import trouble_with
from clpipe.outputs.writer import OutputWriter


@dataclass(frozen=True)
class RunSpec:
    """What a worker is told of a run.

    ``folder`` is where relative paths start, ``first`` an image whose chain is compiled, ``make``
    what the worker must be; the others are those of :class:`clpipe.batch.threads.Batch`.
    """

    entrance: ImageLoader
    target: OutputWriter
    selectors: tuple[str, ...]
    memory: int | None
    threads: int | None
    overwrite: bool
    trace: bool
    run: str = field(default_factory=lambda: secrets.token_hex(8))
    folder: str = field(default_factory=os.getcwd)
    make: "WorkerEnvironment | None" = None
    first: Job | None = None


@dataclass(frozen=True)
class WorkerEnvironment:
    """What decides about bits: the same on all workers of a run."""

    version: str
    device: str
    libraries: str


@dataclass(frozen=True)
class ChunkReport:
    """What became of a chunk; ``error`` is why the whole run cannot go on, if so."""

    outcomes: Sequence[Outcome]
    seconds: float
    error: ClpipeError | None = None


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


def worker_environment(selectors: Sequence[str]) -> WorkerEnvironment:
    """What this process would be as a worker.

    Raises:
        DeviceError: there is no such device.
    """
    device = "numpy"
    if [selector.lower() for selector in selectors] != [device]:
        found = choose_all(selectors, find_devices())
        device = " and ".join(sorted({f"{d.label}, {d.lanes} lanes" for d in found}))
    libraries = {"NumPy": np.__version__, **versions()}
    return WorkerEnvironment(
        __version__, device, ", ".join(f"{k} {v}" for k, v in libraries.items())
    )


def probe_worker(spec: RunSpec, probe: str, size: int | None) -> WorkerEnvironment | str:
    """See whether this process can be a worker of a run; why not, or what it would be.

    Args:
        spec: the run.
        probe: the name of a file that lies in the output folder.
        size: of the first input, in bytes; None where nobody can see it.
    """
    try:
        made = worker_environment(spec.selectors)
    except ClpipeError as error:
        return str(error)
    folder = os.path.join(spec.folder, spec.target.folder)
    assert spec.first
    path = os.path.join(spec.folder, spec.first.path)
    if not os.path.isdir(spec.folder):
        return f"does not see {spec.folder}, where the run was started"
    if not os.path.exists(os.path.join(folder, probe)):
        return f"does not see the output folder {folder}"
    if reason := trouble_with(Path(folder)):
        return f"{folder}: {reason}"
    if size is not None and (not os.path.exists(path) or os.path.getsize(path) != size):
        return f"does not see the input {path}"
    return made


def run_chunk(spec: RunSpec, jobs: Sequence[Job]) -> ChunkReport:
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
    with _turn, contextlib.chdir(spec.folder):
        try:
            made = worker_environment(spec.selectors)
            if made != spec.make:
                _same({"the others": spec.make, worker.address: made})
            assert spec.first
            batch = Batch(
                spec.entrance,
                spec.target,
                _opened(spec.selectors, spec.memory),
                spec.entrance.first_chain([spec.first]),
                spec.threads or worker.state.nthreads,
                spec.overwrite,
                spec.trace,
            )
            _batches[spec.run] = batch
            if spec.run in _halted:
                batch.stop()
            since = time.time() - time.perf_counter()
            for outcome in batch.run(jobs):
                outcomes.append(_moved(outcome, since, f"{worker.address} "))
                if is_abandoned():  # who started the run has gone
                    batch.stop()
        except ClpipeError as problem:
            error = problem
        finally:
            _batches.pop(spec.run, None)
    return ChunkReport(outcomes, time.perf_counter() - began, error)


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
