"""What became of one image, and how long each step took."""

from dataclasses import dataclass

from clpipe.inputs.find import Job

DONE, SKIPPED, LEFT_OUT, FAILED = "done", "skipped", "left out", "failed"


STEPS = ("decode", "device", "encode")


@dataclass(frozen=True)
class Span:
    """When something was done to an image, by which thread, and for how long.

    Args:
        step: one of :data:`STEPS`, or the name of a launch or a transfer within "device".
        worker: the name of the thread.
        start: in s, by time.perf_counter.
        seconds: how long it took.
    """

    step: str
    worker: str
    start: float
    seconds: float


@dataclass(frozen=True)
class Outcome:
    """What became of one job.

    Args:
        job: the job.
        status: "done", "skipped" (its pictures were there already), "left out" (found in a folder,
            but without a picture, or kept after another step than the one to go on from) or
            "failed".
        megapixels: of the image that was read.
        warnings: about the image.
        error: why it failed; "" otherwise.
        reason: what an image that was left out holds in place of a picture; "" otherwise.
        outputs: the files that were written, relative to the output folder.
        began: in s since 1970.
        spans: what was done when.
        clipped: the share of clipped pixels, 0 to 1; of several renditions, the largest.
        old: how many of its renditions are there, but were made by another program.
        layer: the name of the layer that was read as the picture; "" for one without a name.
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

    def seconds(self, step: str) -> float:
        """How many seconds a step took, over all renditions of the image."""
        return sum(span.seconds for span in self.spans if span.step == step)
