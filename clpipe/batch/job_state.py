"""A job from the start of its decoding to its outcome."""

import logging
import threading
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from clpipe.base.errors import ClpipeError, ImageError, RequestError, error_class
from clpipe.base.files import FileGroup
from clpipe.batch.memory_budget import Lease
from clpipe.batch.outcome import DONE, FAILED, Outcome, Span
from clpipe.chain.rendition import Rendition
from clpipe.images.read import SourceImage
from clpipe.inputs.carry import CarriedLayers
from clpipe.inputs.find import Job
from clpipe.inputs.loader import ImageLoader
from clpipe.outputs.patches import Patch
from clpipe.outputs.recipes import Recipe

log = logging.getLogger(__name__)


# The size and the modification time of each file of a job.
Stamps = Sequence[tuple[int, int]]


@dataclass
class DecodedFrame:
    """The image of a frame that was decoded to be metered.

    Args:
        paths: its files on this machine.
        stamps: the stamps of the files when they were read.
        source: the image.
        span: the time of decoding.
        lease: the memory.
        files: removes files that were fetched.
    """

    paths: Sequence[Path]
    stamps: Stamps
    source: SourceImage
    span: Span
    lease: Lease
    files: ExitStack

    def free(self) -> None:
        """Remove the files, and let the next image take the memory."""
        self.files.close()
        self.lease.release()


@dataclass
class JobState:
    """The state of a job, from the start of its decoding to its outcome."""

    job: Job
    loader: ImageLoader
    here: Job  # the job, with files of this machine
    began: float = field(default_factory=time.time)
    spans: list[Span] = field(default_factory=list)
    source: SourceImage | None = None
    stamps: Stamps = ()
    request: Mapping[str, Any] = field(default_factory=dict)  # record of the job's request
    recipes: list[Recipe] = field(default_factory=list)
    status: str = DONE
    error: str = ""
    error_class: str = ""
    device: str = ""  # the name of the device that developed it
    reason: str = ""
    outputs: list[str] = field(default_factory=list)
    carried_layers: CarriedLayers | None = None  # None after they are written
    clipped: float = 0.0  # the largest share of clipped pixels in a rendition
    # Patches that are written instead of pictures.
    patches: list[Patch] = field(default_factory=list)
    old: int = 0  # existing renditions that another version of the program made
    leases: Sequence[Lease] = ()  # the memory that its image takes; () if it is not loaded
    renditions: Sequence[Rendition] = ()  # the renditions to make
    decoded: DecodedFrame | None = None  # the image, if it was decoded to be metered
    files: ExitStack | None = None  # removes files that were fetched, if any were

    def drop_pixels(self) -> None:
        """Free the memory of the image, but keep its size."""
        if self.source:
            empty = np.broadcast_to(np.float16(0), self.source.pixels.shape)
            self.source = replace(self.source, pixels=empty, later=())

    def close(self) -> None:
        """Free what was prepared for an image that is not decoded."""
        if self.files:
            self.files.close()
        if self.decoded:
            self.decoded.free()

    def free(self) -> None:
        """Free the memory of the image, and let the next image take it."""
        self.drop_pixels()
        for lease in self.leases:
            lease.release()

    def fail(self, error: BaseException) -> None:
        """Note why the job fails. The traceback of an unexpected error is logged at level DEBUG."""
        job = self.here
        self.error_class = error_class(error)
        if isinstance(error, ImageError | RequestError | MemoryError):
            self.error = self.loader.error_text(job, error)
        else:
            is_known = isinstance(error, ClpipeError)
            text = str(error) if is_known else f"unexpected {type(error).__name__}: {error}"
            text = text.removesuffix(": ").replace(str(job.path), job.display_name)
            self.error = f"{job.display_name}: {text}"
            log.debug("%s", self.error, exc_info=error)

    @contextmanager
    def timed(self, step: str) -> Iterator[None]:
        """Record the time of a step, and the thread that does it."""
        start = time.perf_counter()
        try:
            yield
        finally:
            self.note(step, start)

    def note(self, step: str, start: float) -> None:
        """Record that this thread has done a step, which began at ``start``."""
        name = threading.current_thread().name
        self.spans.append(Span(step, name, start, time.perf_counter() - start))

    def outcome(self) -> Outcome:
        """Return the outcome of the job."""
        width, height = self.source.pixels.shape[1::-1] if self.source else (0, 0)
        return Outcome(
            self.job,
            FAILED if self.error else self.status,
            width * height / 1e6,
            self.source.warnings if self.source else (),
            self.error,
            self.reason,
            tuple(self.outputs),
            self.began,
            tuple(self.spans),
            self.clipped,
            self.old,
            self.source.layer if self.source else "",
            self.source.part if self.source else 0,
            self.error_class,
            self.device,
        )


@dataclass(frozen=True)
class Written:
    """The files of a rendition, still under temporary names.

    Args:
        group: renames them into place.
        files: their final names, relative to the output directory.
    """

    group: FileGroup
    files: Sequence[str]
