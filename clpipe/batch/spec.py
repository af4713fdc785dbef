"""A run, as it is sent to other processes, on this machine or on others."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from clpipe.batch.outcome import Outcome
from clpipe.batch.room import usual_room
from clpipe.batch.sinks import Folder
from clpipe.batch.threads import Batch
from clpipe.batch.where import Where
from clpipe.batch.work import ImageWorker
from clpipe.chain.request import ResolvedRequest
from clpipe.engine.device import Device
from clpipe.inputs.find import Job
from clpipe.inputs.loader import ImageLoader
from clpipe.outputs.writer import OutputWriter


@dataclass(frozen=True)
class RunSpec:
    """A run, as it is sent to a process.

    Args:
        request: what is asked for.
        where: to which folder, and with which devices.
        first: the job whose chain is compiled early.
        folder: where relative paths start; None is the working directory.
    """

    request: ResolvedRequest
    where: Where
    first: Job
    folder: Path | None = None

    def worker(self) -> ImageWorker:
        """What is done to each image."""
        where = self.where
        loader = ImageLoader(self.request, self.folder)
        sink = Folder(OutputWriter(where.output, self.request), where.redo)
        chain = loader.first_chain([self.first])
        return ImageWorker(loader, sink, chain, where.trace is not None)

    def batch(
        self,
        devices: Sequence[Device | None],
        threads: int,
        sharing: int,
        in_flight: int | None = None,
        compiled: Callable[[], None] = lambda: None,
    ) -> Batch:
        """What does a part of the run.

        Args:
            devices: the process's.
            threads: where the run does not say how many.
            sharing: how many processes share the machine's memory.
            in_flight, compiled: as for :class:`~clpipe.batch.threads.Batch`.
        """
        number = self.where.threads or threads
        room = usual_room(sharing)
        return Batch(self.worker(), devices, number, room, in_flight, compiled)


def shifted(outcome: Outcome, seconds: float, prefix: str = "") -> Outcome:
    """An outcome with the times of another clock, and a prefix before the names of threads."""
    spans = tuple(
        replace(s, worker=prefix + s.worker, start=s.start + seconds) for s in outcome.spans
    )
    return replace(outcome, spans=spans)
