"""Frames of sequences whose chains have state: their order, their state, and what is recomputed."""

import threading
from collections.abc import Callable, Iterable, Iterator
from itertools import groupby

from clpipe.base.errors import RequestError
from clpipe.batch.execution import ExecutionOptions
from clpipe.chain.chain import Chain
from clpipe.chain.rendition import Rendition
from clpipe.engine.state import State, has_state, keeps_state
from clpipe.inputs.find import Job, Place
from clpipe.outputs.recipes import Recipe


def check_frames(
    chain: Chain, is_sequence: bool, execution: ExecutionOptions, dask: str | None
) -> None:
    """Check that a run can do the frames of a chain with state one after the other.

    Args:
        chain: the chain of the first image.
        is_sequence: whether the images are frames of sequences.
        execution: the options of the run.
        dask: the address of a Dask scheduler, or None.

    Raises:
        RequestError: several processes do the work.
    """
    if not has_state(chain):
        return
    step = next(step.name for step in chain.steps if keeps_state(step))
    if is_sequence and (dask is not None or (execution.processes or 1) > 1):
        option = "--processes" if dask is None else "--dask"
        raise RequestError(
            f"{option}: {step} needs the frames of a sequence in one process; remove {option} or "
            f"{step}"
        )


class Turns:
    """Lets frames pass a point in the order of their jobs. Jobs outside sequences do not wait."""

    def __init__(self) -> None:
        self._changed = threading.Condition()  # guards all attributes
        self._waiting: dict[Place | None, None] = {}  # whose turns have not ended, in order
        self._is_closed = False

    def expect(self, job: Job) -> None:
        """Append a job to the order. It must end its turn, even if it fails."""
        if job.place:
            with self._changed:
                self._waiting[job.place] = None

    def wait(self, job: Job) -> bool:
        """Wait until all jobs before have ended their turns. Return False if the run has ended."""
        if not job.place:
            return True
        with self._changed:
            while job.place in self._waiting and next(iter(self._waiting)) != job.place:
                if self._is_closed:
                    return False
                self._changed.wait()
        return True

    def is_first(self, job: Job) -> bool:
        """Return whether all turns of the jobs before a job have ended."""
        with self._changed:
            return next(iter(self._waiting), job.place) == job.place

    def wait_for_all(self) -> None:
        """Wait until all turns have ended, or the run has."""
        with self._changed:
            self._changed.wait_for(lambda: self._is_closed or not self._waiting)

    def end(self, job: Job) -> None:
        """End a job's turn, if it has not ended."""
        if not job.place:
            return
        with self._changed:
            if job.place in self._waiting:
                del self._waiting[job.place]
                self._changed.notify_all()

    def close(self) -> None:
        """End the run: no job waits any longer."""
        with self._changed:
            self._is_closed = True
            self._changed.notify_all()


class Frames:
    """The sequences of a run.

    Args:
        chain: the chain of the first image.
        is_done: returns whether nothing of a frame is made, because its pictures are kept.
    """

    def __init__(self, chain: Chain, is_done: Callable[[Job], bool]) -> None:
        self._chain = chain
        self._is_done = is_done
        self._recomputed: set[str] = set()
        self._states: dict[Rendition, tuple[str, State]] = {}

    def state(self, job: Job, recipe: Recipe) -> State | None:
        """Return the state of a rendition's sequence; None if it has none.

        Call it for frames in temporal order. A sequence's state is dropped when the next begins.
        """
        if not job.place or not has_state(recipe.chain):
            return None
        sequence, state = self._states.get(recipe.rendition, ("", State()))
        if sequence != job.place.sequence:
            state = State()
            self._states[recipe.rendition] = job.place.sequence, state
        return state

    def is_recomputed(self, job: Job) -> bool:
        """Return whether a frame is recomputed, even if its pictures exist."""
        return job.place is not None and job.place.sequence in self._recomputed

    def whole_sequences(self, jobs: Iterable[Job]) -> Iterator[Job]:
        """Yield jobs that are grouped by sequence, and mark sequences that are recomputed.

        With state, a frame needs the one before. If one has to be made, all frames of its sequence
        are. Existing frames are therefore held back until a missing one is found.
        """
        if not has_state(self._chain):
            yield from jobs
            return
        for sequence, frames in groupby(jobs, key=lambda job: job.place and job.place.sequence):
            existing: list[Job] = []
            for job in frames if sequence else ():
                existing.append(job)
                if not self._is_done(job):
                    self._recomputed.add(sequence)
                    break
            yield from existing
            yield from frames
