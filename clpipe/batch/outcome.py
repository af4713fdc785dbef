"""The outcome of one image, and the time that each step took."""

import os
import socket
from dataclasses import dataclass, field
from functools import cache

from clpipe.inputs.find import Job

DONE, SKIPPED, LEFT_OUT, FAILED = "done", "skipped", "left out", "failed"


host_name = cache(socket.gethostname)

STEPS = ("fetch", "decode", "device", "encode")


@dataclass(frozen=True)
class Span:
    """A period of work on an image.

    Args:
        step: one of :data:`STEPS`, or the name of a launch or transfer within "device".
        worker: the name of the thread.
        start: its begin, in s of time.perf_counter.
        seconds: its length.
    """

    step: str
    worker: str
    start: float
    seconds: float


@dataclass(frozen=True)
class Outcome:
    """The outcome of one job of a run, see :func:`clpipe.run`.

    >>> from pathlib import Path
    >>> from clpipe.inputs.find import Job
    >>> outcome = Outcome(Job(Path("renders/a.exr"), "a.exr"), "done", outputs=("a.jpg", "a.json"))
    >>> outcome.job.key, outcome.status, outcome.outputs
    ('a.exr', 'done', ('a.jpg', 'a.json'))

    Args:
        job: the job.
        status: "done", "skipped" (its pictures exist already), "left out" (a file in an input
            directory that holds no picture, or an image kept after a step other than
            ``start_at``), or "failed".
        megapixels: the size of the image that was read.
        warnings: warnings about the image.
        error: why it failed, or "".
        error_class: the class of the error, see :func:`clpipe.base.errors.error_class`; or "".
        device: the name of the device that developed it; "" if none did.
        host: the machine that worked on it.
        pid: the id of the process that worked on it.
        reason: the content of a file that was left out, or "".
        outputs: the files that were written, relative to the output directory.
        began: its begin, in s since 1970.
        spans: the periods of work.
        clipped: the share of clipped pixels, 0 to 1; the largest of its renditions.
        old: the number of existing renditions that another version of the program made.
        layer: the name of the layer that was read as the picture; "" if it has no name.
        part: the number of its part in the file, from 0.
    """

    job: Job
    status: str
    megapixels: float = 0.0
    warnings: tuple[str, ...] = ()
    error: str = ""
    reason: str = ""
    outputs: tuple[str, ...] = ()
    began: float = 0.0
    spans: tuple[Span, ...] = ()
    clipped: float = 0.0
    old: int = 0
    layer: str = ""
    part: int = 0
    error_class: str = ""
    device: str = ""
    host: str = field(default_factory=host_name)
    pid: int = field(default_factory=os.getpid)

    def seconds(self, step: str) -> float:
        """Return the seconds that a step took, summed over all renditions."""
        return sum(span.seconds for span in self.spans if span.step == step)
