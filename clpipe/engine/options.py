"""Options for running a chain on one image."""

from collections.abc import Sequence
from dataclasses import dataclass

from clpipe.base.types import Array
from clpipe.engine.extents import Box
from clpipe.engine.state import State


@dataclass(frozen=True)
class Timing:
    """The device time of one launch or transfer.

    Attributes:
        name: the launch, "upload" or "download".
        seconds: the duration in s.
        start: the start time on the clock of :func:`time.perf_counter`.
        transfer: whether it is a transfer.
    """

    name: str
    seconds: float
    start: float
    transfer: bool


@dataclass(frozen=True)
class RunOptions:
    """Options of one run of a chain on an image.

    Args:
        timings: a list that receives the timing of each launch and transfer (devices only).
        download: False leaves the results on the device, for benchmarks.
        into: an array for the eight-bit pixels, of their shape (devices only). Reusing an array
            saves the time to allocate memory.
        unchanged: whether the image, if it is the previous image's array, has the same pixels.
        boxes: the parts of the results to compute, all of one size, in pixels. The results are
            then stacks of patches. () computes whole images.
        later_exposures: the images of all exposures but the first; see
            :mod:`clpipe.chain.exposures`. () uses the same image.
        state: the state of the sequence that the image is a frame of. Without one, stages with
            state return their input.
    """

    timings: list[Timing] | None = None
    download: bool = True
    into: Array | None = None
    unchanged: bool = False
    boxes: Sequence[Box] = ()
    later_exposures: Sequence[Array] = ()
    state: State | None = None


DEFAULTS = RunOptions()
