"""The description of a run that is sent to other processes, on this machine or on others."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from clpipe.batch.execution import ExecutionOptions
from clpipe.batch.memory_budget import default_budget
from clpipe.batch.outcome import Outcome
from clpipe.batch.sinks import Folder
from clpipe.batch.threads import Batch
from clpipe.batch.work import ImageWorker
from clpipe.chain.request import ResolvedRequest
from clpipe.engine.device import Device
from clpipe.inputs.find import Job
from clpipe.inputs.loader import ImageLoader
from clpipe.outputs.writer import OutputWriter


@dataclass(frozen=True)
class RunSpec:
    """The description of a run that a process receives.

    Args:
        request: the pictures to make.
        execution: the output directory and the devices.
        first: the job whose chain is compiled first.
        folder: the directory that relative paths start from. None is the working directory.
    """

    request: ResolvedRequest
    execution: ExecutionOptions
    first: Job
    folder: Path | None = None

    def worker(self) -> ImageWorker:
        """Return what does the work of each image."""
        execution = self.execution
        loader = ImageLoader(self.request, self.folder)
        sink = Folder(OutputWriter(execution.output, self.request), execution.redo)
        chain = loader.first_chain([self.first])
        return ImageWorker(loader, sink, chain, execution.trace is not None)

    def batch(
        self,
        devices: Sequence[Device | None],
        threads: int,
        sharing: int,
        in_flight: int | None = None,
    ) -> Batch:
        """Return the batch that does this process's part of the run.

        Args:
            devices: the devices of the process.
            threads: the number of threads if the run does not set it.
            sharing: the number of processes that share the machine's memory.
            in_flight: as for :class:`~clpipe.batch.threads.Batch`.
        """
        number = self.execution.threads or threads
        memory = default_budget(sharing)
        return Batch(self.worker(), devices, number, memory, in_flight)


def shifted(outcome: Outcome, seconds: float, prefix: str = "") -> Outcome:
    """Return an outcome with its times shifted, and a prefix before the names of its threads."""
    spans = tuple(
        replace(s, worker=prefix + s.worker, start=s.start + seconds) for s in outcome.spans
    )
    return replace(outcome, spans=spans)
