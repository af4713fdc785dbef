"""TODO."""

from dataclasses import dataclass

from clpipe.inputs.find import Job

DONE, SKIPPED, LEFT_OUT, FAILED = "done", "skipped", "left out", "failed"


STEPS = ("decode", "device", "encode")


@dataclass(frozen=True)
class Span:
    """When something was done to an image, by which thread, and for how long.

    ``step`` is one of :data:`STEPS`, or the name of a launch or a transfer within "device". Times
    are in s, of time.perf_counter.
    """

    step: str
    worker: str
    start: float
    seconds: float


@dataclass(frozen=True)
class Outcome:
    """What became of one job.

    ``status`` is "done", "skipped" (all was there already), "left out" (kept after another stage
    than the one to go on from) or "failed". ``outputs`` are the files that were written, relative
    to the output folder; ``began`` is in s since 1970.
    """

    job: Job
    status: str
    megapixels: float = 0.0
    warnings: tuple[str, ...] = ()
    error: str = ""
    outputs: tuple[str, ...] = ()
    began: float = 0.0
    spans: tuple[Span, ...] = ()

    def seconds(self, step: str) -> float:
        """How long a step took, over all pictures of the image."""
        return sum(span.seconds for span in self.spans if span.step == step)
