"""What runs a batch for a command, and tells of it."""

from collections.abc import Callable, Iterable, Sequence
from contextlib import AbstractContextManager, closing, nullcontext
from typing import TYPE_CHECKING

from clpipe.base.errors import OutputError, RequestError
from clpipe.batch.dask_worker import RunSpec
from clpipe.batch.interrupt import interruptible
from clpipe.batch.run_log import RunLog, Summary
from clpipe.batch.tar_batch import TarBatch
from clpipe.batch.tars import Tar
from clpipe.batch.threads import Batch
from clpipe.batch.trace import Trace
from clpipe.batch.work import ImageWorker
from clpipe.chain.chain import Chain
from clpipe.commands.progress import Reporter
from clpipe.engine.device import Device, open_devices
from clpipe.inputs.find import Job
from clpipe.inputs.loader import ImageLoader
from clpipe.outputs.writer import OutputWriter

if TYPE_CHECKING:
    from clpipe.batch.dask_client import Cluster


def batch_of(
    spec: RunSpec, loader: ImageLoader, chain: Chain, tars: Sequence[Tar], dask: str | None
) -> "AbstractContextManager[Batch | Cluster]":
    """What does the jobs: this machine, with or without tars, or a cluster.

    Args:
        spec: the run.
        loader: of its request.
        chain: of the first image.
        tars: what is made, or none.
        dask: the address of a scheduler, or None.

    Raises:
        RequestError: both tars and a cluster are asked for, or the cluster cannot be used.
        DeviceError: there is no usable device.
    """
    if dask is not None:
        if tars:
            raise RequestError("--dask: it makes no tars; use --webdataset with --shard")
        from clpipe.batch.dask_client import connected

        return connected(dask, spec)
    devices: list[Device | None] = [*open_devices(spec.selectors, spec.memory)] or [None]
    writer = OutputWriter(spec.output, spec.request)
    if tars:
        options = (spec.threads, spec.resuming, spec.trace)
        return nullcontext(TarBatch(tars, loader, writer, chain, devices, *options))
    worker = ImageWorker(loader, writer, chain, spec.resuming, spec.trace)
    return nullcontext(Batch(worker, devices, spec.threads))


def follow(
    batch: "Batch | Cluster",
    jobs: Iterable[Job],
    summary: Summary,
    reporter: Reporter,
    log: RunLog,
    events: Trace | None = None,
    stop: Callable[[], None] | None = None,
) -> None:
    """Run jobs, and note and print the outcome of each as it comes.

    Args:
        batch: what does them.
        jobs: the images.
        summary: counts them.
        reporter: prints them.
        log: notes them.
        events: notes their steps, too.
        stop: is called at Ctrl-C in place of the batch's.

    Raises:
        ClpipeError: the run cannot go on; what is finished is noted.
    """
    unlogged: OutputError | None = None
    with closing(batch.run(jobs)) as outcomes, interruptible(stop or batch.stop), reporter:
        try:
            for outcome in outcomes:
                summary.add(outcome)
                if not unlogged:
                    try:
                        log.add(outcome)
                    except OutputError as error:
                        unlogged = error  # what is in flight is finished, and counted
                        batch.stop()
                reporter.report(outcome)
                if events:
                    events.add(outcome)
            if unlogged:
                raise unlogged
        finally:
            summary.interrupted = summary.finished < summary.total
            if not unlogged:
                log.end(summary)
