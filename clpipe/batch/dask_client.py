"""Many images through the workers of a Dask cluster.

The process that starts a run holds the output folder, cuts the jobs into chunks, hands them out,
and reports outcomes; a worker runs a :class:`clpipe.batch.threads.Batch` on its chunk.
Where a worker dies, Dask gives its chunk to another one, which sees by the sidecars what is done
already and reports it as skipped.
"""

import asyncio
import contextlib
import queue
import time
from collections import deque
from collections.abc import Generator, Iterable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

from clpipe.base.about import __version__
from clpipe.base.errors import ClpipeError, ClusterError, RequestError
from clpipe.base.extras import require
from clpipe.batch.dask_worker import (
    ChunkReport,
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
from clpipe.batch.outcome import FAILED, Outcome
from clpipe.batch.spec import shifted
from clpipe.inputs.find import Job
from clpipe.inputs.loader import ImageLoader
from clpipe.outputs.folder import remove_unfinished

TIMEOUT = 10.0  # s, for the scheduler to answer and for its first worker

PATIENCE = 60.0  # s without any worker, because nannies and job queues start new ones

RETRIES = 2  # of a chunk that ended with an unexpected error

FIRST, LARGEST = 4, 64  # images in a chunk

SHORT, LONG = 15.0, 60.0  # s; after a shorter chunk they grow, after a longer one they shrink


@contextlib.contextmanager
def connected(address: str, spec: DaskSpec) -> Iterator["Cluster"]:
    """The cluster of a scheduler.

    Raises:
        RequestError: distributed is not installed, the scheduler does not answer, it has no
            workers, or they have different versions of clpipe.
    """
    require("--dask", "distributed")
    from distributed import Client

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
        versions = client.run(lambda: __import__("clpipe").__version__, on_error="return")
        for worker, version in versions.items():
            if isinstance(version, BaseException):
                raise RequestError(f"--dask: worker {worker} cannot load clpipe: {version}")
        check_same("version of clpipe", {"this machine": __version__, **versions})
        yield Cluster(client, address, spec)
    finally:
        with contextlib.suppress(OSError, TimeoutError):
            client.run(close_devices, on_error="ignore")
        client.close()


async def _reach(address: str) -> None:
    """Connect to a scheduler. A Client would wait for ever where something listens but is silent.

    Raises:
        OSError, ValueError: no scheduler answers there, or it is no address.
    """
    from distributed import Security
    from distributed.comm import connect

    security = Security().get_connection_args("client")
    comm = await asyncio.wait_for(connect(address, timeout=TIMEOUT, **security), TIMEOUT)
    await comm.close()


class Cluster:
    """The workers of a cluster, with the interface of a :class:`clpipe.batch.threads.Batch`."""

    def __init__(self, client: Any, address: str, spec: DaskSpec) -> None:
        self._client = client
        self._address = address
        self._spec = spec.anchored()
        self.is_stopping = False
        self._finished: queue.SimpleQueue[Any] = queue.SimpleQueue()  # futures; None means stop
        self._running: dict[Any, tuple[list[Job], bool]] = {}  # chunks, and whether each runs alone
        self._seen = time.monotonic()  # when there was a worker

    def stop(self) -> None:
        """Let no more images in; those in flight are finished. May be called by a signal."""
        self.is_stopping = True
        self._finished.put(None)

    def run(self, jobs: Iterable[Job]) -> Generator[Outcome, None, None]:
        """Do every job; one that fails is reported and the others go on.

        Outcomes come as chunks are finished, in any order.

        Raises:
            RequestError: workers have different environments, no such device, or do not see the
                files.
            DeviceError: a kernel does not compile.
            OutputError: nothing can be written any more.
            ClusterError: the scheduler or all workers have gone.
        """
        anchored = list(map(self._spec.anchored_job, jobs))
        self._probe(anchored)
        return self._outcomes(anchored)

    def _probe(self, jobs: Sequence[Job]) -> None:
        """See that all workers have one environment, and see the same files as this machine."""
        takes = ImageLoader(self._spec.request).raw.takes
        # The chain of a raw is compiled only where all inputs are raws, as in first_chain().
        able = [job for job in jobs if not job.problem] or jobs
        first = next((job for job in able if not takes(job.path)), able[0])
        spec = replace(self._spec, first=first)
        size = first.path.stat().st_size if first.path.is_file() else None
        probe = spec.where.output / f".clpipe.{spec.run}"
        try:
            probe.touch()
            environments = self._client.run(probe_worker, spec, probe.name, size, on_error="return")
        finally:
            with contextlib.suppress(OSError):
                probe.unlink()
        if not environments:
            raise self._gone()
        for worker, environment in environments.items():
            if not isinstance(environment, WorkerEnvironment):
                raise RequestError(f"--dask: worker {worker}: {environment}")
        check_same_environment(environments)
        self._spec = replace(spec, environment=next(iter(environments.values())))

    def _outcomes(self, jobs: Sequence[Job]) -> Generator[Outcome, None, None]:
        chunks = _Chunks(deque(jobs))
        failure: ClpipeError | None = None
        try:
            while self._running or (chunks and not self.is_stopping):
                self._hand_out(chunks)
                try:
                    future = self._finished.get(timeout=1)
                except queue.Empty:
                    continue
                if future is None:
                    self._halt()
                    continue
                report = self._report(future, chunks)
                chunks.took(report.seconds)
                here = time.perf_counter() - time.time()
                for outcome in report.outcomes:
                    yield shifted(outcome, here)
                if report.error:
                    failure = failure or report.error
                    self._halt()
        except GeneratorExit:
            self._finish()
            raise
        patches = self._spec.request.patch is not None
        remove_unfinished(self._spec.where.output, jobs, patches)  # by workers that died
        if failure:
            raise failure

    def _hand_out(self, chunks: "_Chunks") -> None:
        """Submit chunks until there are as many as workers.

        Dask chooses the worker; a chunk that is tied to one would wait for ever where it dies.

        Raises:
            ClusterError: there have been no workers for long, or the scheduler has gone.
        """
        try:
            addresses = tuple(sorted(self._client.nthreads()))
        except (OSError, ValueError, RuntimeError):
            raise self._gone() from None
        self._spec = replace(self._spec, workers=addresses)
        if workers := len(addresses):
            self._seen = time.monotonic()
        elif time.monotonic() - self._seen > PATIENCE:
            raise ClusterError(
                f"--dask: the scheduler at {self._address} has had no workers for {PATIENCE:g} s; "
                "what is finished is there, and the same command goes on"
            )
        while chunks.jobs and len(self._running) < workers and not self.is_stopping:
            self._submit(chunks.cut(workers))
        if chunks.suspects and not self._running and not self.is_stopping:
            self._submit([chunks.suspects.popleft()], alone=True)

    def _submit(self, chunk: list[Job], alone: bool = False) -> None:
        future = self._client.submit(run_chunk, self._spec, chunk, pure=False, retries=RETRIES)
        self._running[future] = (chunk, alone)
        future.add_done_callback(self._finished.put)

    def _report(self, future: Any, chunks: "_Chunks") -> ChunkReport:
        """What became of a chunk that is finished.

        Raises:
            ClusterError: the scheduler has gone.
        """
        from distributed import KilledWorker

        chunk, alone = self._running.pop(future)
        try:
            return future.result()
        except KilledWorker as error:
            if not alone:
                chunks.suspects += chunk  # another chunk on these workers may be to blame
                return ChunkReport((), LONG)
            deaths = f"{error.allowed_failures + 1} in all, the last one {_worker_name(error)}"
            return _failed(chunk, f"killed the worker that took it, {deaths}")
        except Exception as error:
            if future.status in ("cancelled", "lost"):
                raise self._gone() from None
            return _failed(chunk, f"on a worker: {type(error).__name__}: {error}")
        finally:
            future.release()  # else Dask does it again where its worker dies

    def _halt(self) -> None:
        """Let the workers finish what is in flight."""
        self.is_stopping = True
        self._client.run(halt, self._spec.run, on_error="ignore")

    def _finish(self) -> None:
        """Wait until no worker is busy with the run."""
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
    """The jobs that are left, to be cut into chunks.

    Chunks grow while they take little time, and get smaller towards the end. ``suspects`` are jobs
    whose workers died; each is tried alone in the end.

    >>> from pathlib import Path
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
        """Adapt the size of chunks to how long one took."""
        if seconds < SHORT:
            self.size = min(2 * self.size, LARGEST)
        elif seconds > LONG:
            self.size = max(self.size // 2, 1)


def _failed(chunk: Sequence[Job], reason: str) -> ChunkReport:
    failed = (Outcome(job, FAILED, error=f"{job.path}: {reason}") for job in chunk)
    return ChunkReport(list(map(as_written, failed)), LONG)


def _worker_name(error: Any) -> str:
    return str(getattr(error.last_worker, "address", error.last_worker))
