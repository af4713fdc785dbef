"""The interfaces of a run: executors process images, and sinks receive the pictures.

There are three executors: :class:`clpipe.batch.threads.Batch` (threads of this process),
:class:`clpipe.batch.processes.Processes` (processes of this machine) and
:class:`clpipe.batch.dask_client.Cluster` (workers of a Dask scheduler). There are four sinks: the
output directory (:class:`Folder`), clips (:class:`clpipe.batch.clip_sink.Clips`) or tars in it
(:class:`clpipe.batch.tar_sink.Tars`), and tars at a URL
(:class:`clpipe.batch.remote_tars.RemoteTars`).
"""

from abc import abstractmethod
from collections.abc import Callable, Generator, Iterable, Mapping
from concurrent.futures import Future, ThreadPoolExecutor
from typing import Any, Generic, Protocol, TypeVar

from clpipe.batch.outcome import DONE, SKIPPED, Outcome
from clpipe.chain.rendition import Rendition
from clpipe.inputs.find import Job
from clpipe.outputs.existing import ExistingFiles, Redo, find_existing
from clpipe.outputs.writer import OutputWriter


class Executor(Protocol):
    """Processes jobs and yields their outcomes. Each executor runs once."""

    @property
    def is_stopping(self) -> bool:
        """Whether :meth:`stop` was called, or the run cannot continue."""

    def stop(self) -> None:
        """Begin no more images, and finish those in flight. A signal handler may call it."""

    def run(self, jobs: Iterable[Job]) -> Generator[Outcome, None, None]:
        """Yield the outcome of each job, in any order. A job that fails has an outcome too.

        Raises:
            RequestError: the request cannot be run here.
            DeviceError: no device is usable.
            OutputError: nothing more can be written. Images in flight are reported first.
        """


class Folder:
    """The output directory as a sink, and the base class of other sinks.

    A sink of your own overrides what differs. Override :meth:`receive` to move finished files
    elsewhere, and :meth:`found` if they are not in the directory any more. To change the names of
    files, pass another ``writer`` to this constructor.

    Args:
        writer: writes the files of a rendition.
        redo: which existing pictures are recomputed.

    Attributes:
        allows_processes: whether several processes may write its pictures. Processes search for
            existing pictures in the output directory only, so a sink that overrides ``found`` sets
            this to False.
        waiting: called with 1 if an image's pictures wait for the file that will contain them, and
            with -1 before its outcome is yielded.
    """

    allows_processes = True

    def __init__(self, writer: OutputWriter, redo: Redo = Redo.OLD) -> None:
        self.writer = writer
        self.redo = redo
        self.waiting: Callable[[int], None] = lambda change: None

    def found(self, job: Job, rendition: Rendition, request: Mapping[str, Any]) -> ExistingFiles:
        """Return what exists of a rendition. The threads of an executor call it at the same time.

        Args:
            job: the image.
            rendition: one of its pictures.
            request: the record of the request, see :meth:`OutputWriter.request_record`.

        Raises:
            ImageError: a file with the name of an output was not written by clpipe.
        """
        return find_existing(self.writer.files(job, rendition), job, request, self.redo.verifies)

    def receive(self, executor: Executor, jobs: Iterable[Job]) -> Generator[Outcome, None, None]:
        """Let an executor do the jobs, and yield their outcomes.

        An outcome names files that exist: it comes after they have been written to the disk.

        Raises:
            RequestError, DeviceError, OutputError: as :meth:`Executor.run`.
        """
        return executor.run(jobs)


class Group(Protocol):
    """Images whose pictures become parts of one file."""

    def add(self, outcome: Outcome) -> bool:
        """Add the outcome of an image. Return whether it was the last one."""


G = TypeVar("G", bound=Group)


class GroupSink(Folder, Generic[G]):
    """A sink that packs the pictures of several images into one file."""

    allows_processes = False

    @abstractmethod
    def group(self, job: Job) -> G:
        """Return the group of an image."""

    @abstractmethod
    def named(self, outcome: Outcome) -> Outcome:
        """Return an outcome that names the packed file instead of hidden ones."""

    @abstractmethod
    def finish(self, group: G, outcomes: list[Outcome]) -> list[Outcome]:
        """Write the file of a group, in a thread of its own.

        Args:
            group: the group, complete.
            outcomes: the outcomes of its images that were done or skipped.

        Returns:
            These outcomes, as :meth:`named` returns them.

        Raises:
            OutputError: it cannot be written.
        """

    def receive(self, executor: Executor, jobs: Iterable[Job]) -> Generator[Outcome, None, None]:
        """Let an executor do the jobs, and yield each outcome after the file of its group exists.

        A group is packed while the pictures of the next one are made. Failures are yielded at once.
        If the run stops, the images of incomplete groups have no outcome. The next run skips them.

        Raises:
            RequestError, DeviceError, OutputError: as :meth:`Executor.run`.
        """
        held: dict[int, list[Outcome]] = {}  # by the id of the group
        packed: Future[list[Outcome]] | None = None
        with ThreadPoolExecutor(1, "pack") as pool:
            for outcome in executor.run(jobs):
                group = self.group(outcome.job)
                outcomes = held.setdefault(id(group), [])
                is_last = group.add(outcome)
                if outcome.status in (DONE, SKIPPED):
                    outcomes.append(outcome)
                    self.waiting(+1)
                else:
                    yield self.named(outcome)
                if packed and (is_last or packed.done()):
                    yield from self._released(packed.result())
                    packed = None
                if is_last:
                    packed = pool.submit(self.finish, group, held.pop(id(group)))
            if packed:
                yield from self._released(packed.result())

    def _released(self, outcomes: Iterable[Outcome]) -> Generator[Outcome, None, None]:
        for outcome in outcomes:
            self.waiting(-1)
            yield outcome
