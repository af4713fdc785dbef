"""Work for a device: one image that is to go through a plan, and where its results go."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Generic, TypeVar

import numpy as np

from clpipe.base.types import Array
from clpipe.engine.bindings import Bind
from clpipe.engine.buffers import HostImages, core_of
from clpipe.engine.extents import Extent, Extents
from clpipe.engine.ir import Plan
from clpipe.engine.options import RunOptions

R = TypeVar("R")


@dataclass(frozen=True, eq=False)
class Work(Generic[R]):
    """An image that is to go through a device.

    Args:
        plan: what is done.
        source: the image, (height, width[, channel]), of a type that converts without loss to what
            the plan reads, half or float. It must stay as it is until the results are taken.
        bind: returns the values of kernel parameters.
        output: where the results go.
        options: what comes back, and how.
        finish: makes a result of the output.
    """

    plan: Plan
    source: Array
    bind: Bind
    output: HostImages
    options: RunOptions
    finish: Callable[[HostImages], R]

    @property
    def size(self) -> tuple[int, int]:
        """The width and height of the image, in px."""
        return self.source.shape[1], self.source.shape[0]

    @property
    def is_for_itself(self) -> bool:
        """Whether it shares no launch with other work: it is timed, or has an output of its own."""
        options = self.options
        is_usual = options.download and options.timings is None and options.into is None
        return self.plan.incremental or not is_usual


@dataclass(frozen=True, eq=False)
class Member:
    """A part of an image that goes through a plan in one go: the image, a tile or a patch of it.

    Args:
        extents: its place on each level.
        work: what is done to the image.
        patch: which of the image's patches it is; None is no patch.
        is_whole: whether it is the image.
    """

    extents: Extents
    work: Work[Any]
    patch: int | None = None
    is_whole: bool = False

    @property
    def pixels(self) -> Array:
        """What it stores of the source, as the plan reads it."""
        box = self.extents[0].stored
        pixels = self.work.source[box.top : box.bottom, box.left : box.right]
        return pixels.transpose(2, 0, 1) if self.work.plan.planar else pixels

    @property
    def dtype(self) -> Any:
        """The type of the source's samples on the device."""
        return np.float16 if self.work.plan.half else np.float32

    def part_of(self, result: Array, extent: Extent) -> Array:
        """The part of a result of its image that it makes."""
        return core_of(extent, result) if self.patch is None else result[self.patch]
