"""The workers of a Dask cluster that share a run.

The process that starts the run holds the output directory, cuts the jobs into chunks, submits
them, and reports outcomes. A worker runs a :class:`clpipe.batch.threads.Batch` on each chunk. If a
worker dies, Dask gives its chunk to another one, which sees from the sidecars what is finished and
reports it as skipped.
"""

import asyncio
import contextlib
import logging
import time
from collections.abc import Generator, Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from typing import Any

from clpipe.base.about import __version__
from clpipe.base.errors import ClusterError, RequestError
from clpipe.base.extras import require
from clpipe.batch.chunks import ChunkExecutor, ChunkReport, WorkerDiedError
from clpipe.batch.dask_worker import (
    DaskSpec,
    WorkerEnvironment,
    as_written,
    check_same,
    check_same_environment,
    close_devices,
    halt,
    probe_worker,
    run_chunk,
)
from clpipe.batch.outcome import Outcome
from clpipe.batch.spec import shifted
from clpipe.inputs.find import Job
from clpipe.inputs.loader import ImageLoader

log = logging.getLogger(__name__)

CONNECT_TIMEOUT = 10.0  # s; the wait for the scheduler's answer

# s; the waits for the first worker, which a job queue may start late, and for one after all have
# gone.
FIRST_TIMEOUT, WORKER_TIMEOUT = 3600.0, 600.0
NOTE_SECONDS = 5.0  # s; a longer wait for a worker is announced

RETRIES = 2  # retries of a chunk that ended with an unexpected error

# s; chunks grow after one that took less time, and shrink after one that took more.
SHORT_CHUNK, LONG_CHUNK = (
    15.0,
    60.0,
)


@contextlib.contextmanager
def connected(address: str, spec: DaskSpec) -> Iterator["Cluster"]:
    """Connect to the cluster of a scheduler.

    Raises:
        RequestError: distributed is not installed, or the scheduler does not answer.
    """
    require("--dask", "dask")
    from distributed import Client

    try:
        asyncio.run(_reach(address))
        client = Client(address, timeout=CONNECT_TIMEOUT, name="clpipe", set_as_default=False)
    except (OSError, ValueError) as error:
        raise RequestError(
            f"--dask: no Dask scheduler answers at {address!r} within {CONNECT_TIMEOUT:g} s"
            f"{f' ({error})' * bool(str(error))}; expected tcp://HOST:PORT of a running scheduler"
        ) from None
    try:
        yield Cluster(client, address, spec)
    finally:
        with contextlib.suppress(OSError, TimeoutError):
            client.run(close_devices, on_error="ignore")
        client.close()


async def _reach(address: str) -> None:
    """Connect to a scheduler within a time limit. A Client would wait forever for a silent port.

    Raises:
        OSError, ValueError: no scheduler answers, or the address is not valid.
    """
    from distributed import Security
    from distributed.comm import connect

    security = Security().get_connection_args("client")
    comm = await asyncio.wait_for(
        connect(address, timeout=CONNECT_TIMEOUT, **security), CONNECT_TIMEOUT
    )
    await comm.close()


class Cluster(ChunkExecutor):
    """The workers of a cluster; an :class:`~clpipe.batch.sinks.Executor`."""

    _spec: DaskSpec

    def __init__(self, client: Any, address: str, spec: DaskSpec) -> None:
        super().__init__(spec.with_absolute_paths(), SHORT_CHUNK, LONG_CHUNK)
        self._client = client
        self._address = address
        self._last_worker_time = time.monotonic()  # the last time at which there was a worker

    def run(self, jobs: Iterable[Job]) -> Generator[Outcome, None, None]:
        """Do every job, and yield outcomes as chunks finish, in any order.

        Raises:
            RequestError: there are no workers. Or they have different environments or versions of
                clpipe, lack the device, or do not see the files.
            DeviceError: a kernel does not compile.
            OutputError: nothing more can be written.
            ClusterError: the scheduler or all workers are gone.
        """
        with_absolute_paths = list(map(self._spec.absolute_job, jobs))
        if not self._wait_for_worker():
            return
        self._probe(with_absolute_paths)
        try:
            yield from self._outcomes(with_absolute_paths)
        except GeneratorExit:
            self._finish()
            raise

    def _wait_for_worker(self) -> bool:
        """Wait until a worker has done a task. Adaptive clusters start workers only for tasks.

        Returns:
            False after a stop.

        Raises:
            RequestError: no worker has come, or a worker has another version of clpipe.
        """
        task = self._client.submit(lambda: __import__("clpipe").__version__, pure=False)
        start, is_noted = time.monotonic(), False
        while not self.is_stopping and task.status == "pending":
            waited = time.monotonic() - start
            if waited > FIRST_TIMEOUT:
                raise RequestError(
                    f"--dask: the scheduler at {self._address} has no workers; start some: "
                    f"dask worker {self._address}"
                )
            if waited > NOTE_SECONDS and not is_noted:
                is_noted = True
                text = "--dask: waiting for a worker; to start one: dask worker %s"
                log.info(text, self._address)
            time.sleep(0.05)
        if self.is_stopping:
            return False
        versions = self._client.run(lambda: __import__("clpipe").__version__, on_error="return")
        if task.status == "error":
            versions["of the first task"] = task.exception()
        for worker, version in versions.items():
            if isinstance(version, BaseException):
                raise RequestError(f"--dask: worker {worker} cannot load clpipe: {version}")
        check_same("version of clpipe", {"this machine": __version__, **versions})
        return True

    def _probe(self, jobs: Sequence[Job]) -> None:
        """Check that all workers have one environment, and see the same files as this machine."""
        is_raw = ImageLoader(self._spec.request).raw.is_raw
        # Like in first_chain(), the chain of a raw is compiled only if all inputs are raws.
        usable = [job for job in jobs if not job.problem] or jobs
        first = next((job for job in usable if not is_raw(job.path)), usable[0])
        spec = replace(self._spec, first=first)
        size = first.path.stat().st_size if first.path.is_file() else None
        probe = spec.execution.output / f".clpipe.{spec.run}"
        try:
            probe.touch()
            check = spec, probe.name, size
            task = self._client.submit(probe_worker, *check, pure=False)  # keeps a worker
            environments = self._client.run(probe_worker, *check, on_error="return")
            environments = environments or {"of the first task": task.result()}
        finally:
            with contextlib.suppress(OSError):
                probe.unlink()
        for worker, environment in environments.items():
            if not isinstance(environment, WorkerEnvironment):
                raise RequestError(f"--dask: worker {worker}: {environment}")
        check_same_environment(environments)
        self._spec = replace(spec, environment=next(iter(environments.values())))

    def _submit_chunks(self) -> bool:
        """Submit one chunk more than workers have threads, so that adaptive clusters grow.

        Dask chooses the worker. A chunk that is bound to one would wait for ever if it dies.

        Raises:
            ClusterError: there has been no worker for long, or the scheduler is gone.
        """
        try:
            workers = self._client.nthreads()
        except (OSError, ValueError, RuntimeError):
            raise self._lost_cluster() from None
        self._spec = replace(self._spec, workers=tuple(sorted(workers)))
        threads = sum(workers.values())
        if workers:
            self._last_worker_time = time.monotonic()
        elif time.monotonic() - self._last_worker_time > WORKER_TIMEOUT:
            raise ClusterError(
                f"--dask: the scheduler at {self._address} has had no workers for "
                f"{WORKER_TIMEOUT:g} s; finished pictures are kept, and the same command resumes"
            )
        if self.is_stopping:
            return bool(self._held and workers)  # without workers, the other chunks wait for some
        while self._chunks.jobs and len(self._held) <= threads:
            self._submit(self._chunks.cut(threads + 1))
        if self._chunks.suspects and not self._held:
            self._submit([self._chunks.suspects.popleft()])
        return bool(self._held)

    def _submit(self, chunk: list[Job]) -> None:
        future = self._client.submit(run_chunk, self._spec, chunk, pure=False, retries=RETRIES)
        self._held[future] = {job.stem: job for job in chunk}
        future.add_done_callback(self._finished.put)

    def _result(self, future: Any, held: Mapping[str, Job]) -> ChunkReport:
        from distributed import KilledWorker

        try:
            return future.result()
        except KilledWorker as error:
            deaths = f"{error.allowed_failures + 1} in all, the last one {_worker_name(error)}"
            raise WorkerDiedError(f"killed the worker that took it, {deaths}") from None
        except Exception as error:
            if future.status in ("cancelled", "lost"):
                raise self._lost_cluster() from None
            return self._failed(held, f"on a worker: {type(error).__name__}: {error}")
        finally:
            future.release()  # otherwise Dask recomputes the result if its worker dies

    def _localized(self, outcome: Outcome) -> Outcome:
        return shifted(as_written(outcome), time.perf_counter() - time.time())

    def _halt(self) -> None:
        self._client.run(halt, self._spec.run, on_error="ignore")

    def _finish(self) -> None:
        """Stop, and wait until no worker is busy with the run."""
        from distributed import wait

        self._halt()
        with self._client.as_current(), contextlib.suppress(TimeoutError):
            wait(list(self._held), timeout=LONG_CHUNK)

    def _lost_cluster(self) -> ClusterError:
        return ClusterError(
            f"--dask: the scheduler at {self._address} or its workers have gone; "
            "finished pictures are kept, and the same command resumes"
        )


def _worker_name(error: Any) -> str:
    return str(getattr(error.last_worker, "address", error.last_worker))
