"""Options of a run that do not change its pictures, such as devices and threads."""

from dataclasses import dataclass
from pathlib import Path

from clpipe.base.errors import RequestError
from clpipe.outputs.existing import Redo


@dataclass(frozen=True)
class ExecutionOptions:
    """Where and how a run is executed. Its pictures do not depend on these options.

    Args:
        output: the output directory.
        devices: indices or parts of names from ``clpipe devices``, or "numpy". () is the first GPU
            and all GPUs like it, or else the CPU.
        memory: the memory limit of a device in bytes. Larger images are processed in tiles. None
            is the free memory.
        threads: the number of threads that decode, and of threads that encode. None is one per
            processor.
        redo: which existing pictures are recomputed.
        trace: the file for a timeline, or None.
        processes: the number of processes that share the work on this machine. None chooses it
            from the number and size of the images.
    """

    output: Path
    devices: tuple[str, ...] = ()
    memory: int | None = None
    threads: int | None = None
    redo: Redo = Redo.OLD
    trace: Path | None = None
    processes: int | None = None


def check_processes(execution: ExecutionOptions, dask: str | None, per_tar: int | None) -> None:
    """Check that the number of processes fits the way the run is done.

    Raises:
        RequestError: a cluster does the work, or tars are packed.
    """
    if execution.processes is None or execution.processes == 1:
        return
    if dask is not None:
        raise RequestError("--processes: with --dask the cluster's workers are the processes")
    if per_tar:
        raise RequestError(
            "--processes: a tar is packed by one process; run several, each with a --shard"
        )
