"""Options of one run of an image, besides its chain."""

from collections.abc import Sequence
from dataclasses import dataclass

from clpipe.base.types import Array
from clpipe.engine.extents import Box


@dataclass(frozen=True)
class Timing:
    """The time that one launch or transfer took, in seconds on the device.

    ``start`` is on the clock of :func:`time.perf_counter`. Transfers are called "upload" and
    "download".
    """

    name: str
    seconds: float
    start: float
    transfer: bool


@dataclass(frozen=True)
class RunOptions:
    """Options of one run: how an image is put through a chain, and what comes back.

    Args:
        timings: one entry a launch and transfer that is done is appended (devices only).
        download: False leaves the results on the device, for measuring.
        into: an array to use for the eight-bit pixels (devices only), of their shape; a used one
            saves the time that new memory takes.
        unchanged: the image, if it is the same array as that before, has the same pixels still.
        boxes: the parts of the results that are made, all of one size, in their pixels; () is all
            of them. Results are then stacks of patches.
        later: what the exposures behind the first one see, see
            :mod:`clpipe.chain.exposures`; () is the same image.
    """

    timings: list[Timing] | None = None
    download: bool = True
    into: Array | None = None
    unchanged: bool = False
    boxes: Sequence[Box] = ()
    later: Sequence[Array] = ()


DEFAULTS = RunOptions()
