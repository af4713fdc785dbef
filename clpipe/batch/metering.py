"""Meters the frames of a run's sequences, and keeps their images until they are developed.

A frame is metered before it is known whether its pictures exist, because its settings are part of
their request. Its image is therefore decoded first, and kept for the thread that develops it.
"""

import threading
import time
from collections.abc import Callable, Iterable, Iterator
from contextlib import ExitStack
from dataclasses import replace
from functools import cache

from clpipe.base.errors import ImageError
from clpipe.base.urls import fetched_files
from clpipe.batch.execution import ExecutionOptions
from clpipe.batch.job_state import DecodedFrame
from clpipe.batch.memory_budget import Lease, MemoryBudget, default_budget
from clpipe.batch.outcome import Span
from clpipe.batch.work import ImageWorker
from clpipe.engine.device import open_device
from clpipe.engine.runner import Result
from clpipe.engine.service import Frame, Service
from clpipe.inputs.find import Job
from clpipe.inputs.loader import ImageLoader, LoadedImage
from clpipe.inputs.metering import metered_jobs


class Metering:
    """Meters frames in the order of their jobs, and keeps the image of the last one.

    Args:
        worker: does the work of each image.
        acquire: waits until a frame's image fits into memory, and takes the memory.
        develop: develops a frame, and returns its result.
        keeps: whether images are kept for :meth:`take`.
    """

    def __init__(
        self,
        worker: ImageWorker,
        acquire: Callable[[Job], Lease],
        develop: Callable[[Frame], Result],
        keeps: bool = True,
    ) -> None:
        self._worker = worker
        self._acquire = acquire
        self._develop = develop
        self._keeps = keeps
        self._kept: dict[str, DecodedFrame] = {}  # one at most, by the stem of its job
        self._is_closed = False
        self._changed = threading.Condition()  # guards the attributes above
        self._last_queued = ""  # the stem of a job

    def jobs(self, jobs: Iterable[Job]) -> Iterator[Job]:
        """Yield frames with the settings of their sequence; see :func:`metered_jobs`.

        If the code that iterates asks for the next frame before it has queued the last one, it
        collects frames. They would fill the memory, so their images are decoded again later.
        """
        for job in metered_jobs(self._worker.loader, jobs, self._develop, self._load):
            if not self._keeps:
                self.drop(job)
            yield job
            if job.stem != self._last_queued:
                self.drop(job)

    def queue(self, job: Job, has_turn: bool) -> bool:
        """Note that the thread that develops a frame will take its image.

        Args:
            job: the frame.
            has_turn: whether all frames before have memory. Otherwise, the image is dropped: frames
                that have memory would wait for others that do not.

        Returns:
            Whether the image is kept.
        """
        self._last_queued = job.stem
        if not has_turn:
            self.drop(job)
        return job.stem in self._kept

    def take(self, job: Job) -> DecodedFrame | None:
        """Return the image that is kept for a frame, if there is one, and keep it no longer."""
        if not self._kept:  # most runs meter nothing
            return None
        with self._changed:
            decoded = self._kept.pop(job.stem, None)
            self._changed.notify_all()
            return decoded

    def drop(self, job: Job) -> None:
        """Free the image that is kept for a frame, if there is one."""
        if decoded := self.take(job):
            decoded.free()

    def close(self) -> None:
        """End the run: free the image that is kept, and load no others."""
        with self._changed:
            self._is_closed = True
            self._changed.notify_all()
            for decoded in self._kept.values():
                decoded.free()
            self._kept.clear()

    def _load(self, loader: ImageLoader, job: Job) -> LoadedImage:
        """Load a frame's image to be metered, and keep it.

        Args:
            loader: the loader of the frame.
            job: the frame.

        Raises:
            ImageError, RequestError: the image cannot be read, or the run has ended.
        """
        with self._changed:
            self._changed.wait_for(lambda: self._is_closed or not self._kept)
            if self._is_closed:
                raise ImageError("the run ended before this frame was metered")
        with ExitStack() as files:
            first, *others = files.enter_context(fetched_files(job.paths))
            here = replace(job, path=first, subframes=tuple(others))
            with ExitStack() as stack:
                lease = stack.enter_context(self._acquire(here))
                start = time.perf_counter()
                stamps, loaded = self._worker.read(loader, here)
                assert loaded  # None is possible only with --start-at
                thread, seconds = threading.current_thread().name, time.perf_counter() - start
                span = Span("decode", thread, start, seconds)
                stack.pop_all()
            kept = DecodedFrame(here.paths, stamps, loaded.source, span, lease, files.pop_all())
        with self._changed:
            self._kept[job.stem] = kept
        if self._is_closed:
            self.close()
        return loaded


def metering_ahead(worker: ImageWorker, execution: ExecutionOptions) -> Metering:
    """Return what meters for a run whose frames other processes develop.

    It opens the first device of the run, once a frame is metered. One image at a time is in memory.
    """

    @cache
    def opened() -> tuple[Service, MemoryBudget]:
        device = open_device(next(iter(execution.devices), None), execution.memory)
        budget = MemoryBudget(default_budget(), [device])
        budget.device_ready()
        return Service([device]), budget

    def acquire(job: Job) -> Lease:
        service, budget = opened()
        return budget.acquire(worker.bytes_of(job, 1, in_numpy=None in service.devices))

    def develop(frame: Frame) -> Result:
        return opened()[0].run(frame)

    return Metering(worker, acquire, develop, keeps=False)
