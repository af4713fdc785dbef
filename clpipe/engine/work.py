"""Work for a device: one image, its plan, and the arrays for its results."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Generic, TypeVar

import numpy as np

from clpipe.base.types import Array
from clpipe.engine.bindings import Bind
from clpipe.engine.buffers import HostImages, core_view
from clpipe.engine.extents import Extent, Extents
from clpipe.engine.ir import Plan
from clpipe.engine.options import RunOptions

R = TypeVar("R")


@dataclass(frozen=True, eq=False)
class Work(Generic[R]):
    """One image for a device.

    Args:
        plan: the plan.
        source: the image, (height, width[, channel]), of a type that converts without loss to the
            plan's float16 or float32. It must not change until the results are fetched.
        bind: returns the values of kernel parameters.
        output: the arrays for the results.
        options: the options of the run.
        finish: converts the output to the result.
    """

    plan: Plan
    source: Array
    bind: Bind
    output: HostImages
    options: RunOptions
    finish: Callable[[HostImages], R]

    @property
    def size(self) -> tuple[int, int]:
        """The width and height of the image, in pixels."""
        return self.source.shape[1], self.source.shape[0]

    @property
    def is_for_itself(self) -> bool:
        """Whether the image must not share launches, for example because it is timed."""
        options = self.options
        is_usual = options.download and options.timings is None and options.into is None
        return options.state is not None or not is_usual


@dataclass(frozen=True, eq=False)
class Member:
    """A part of an image that one pass over a plan processes: the whole image, a tile or a patch.

    Args:
        extents: the extents of the part on each level.
        work: the work of the image.
        patch: the number of the patch; None if the part is no patch.
        is_whole: whether the part is the whole image.
    """

    extents: Extents
    work: Work[Any]
    patch: int | None = None
    is_whole: bool = False

    @property
    def pixels(self) -> Array:
        """The stored part of the source, with the axes that the plan reads."""
        box = self.extents[0].stored
        pixels = self.work.source[box.top : box.bottom, box.left : box.right]
        return pixels.transpose(2, 0, 1) if self.work.plan.planar else pixels

    @property
    def dtype(self) -> Any:
        """The type of the source's samples on the device."""
        return np.float16 if self.work.plan.half else np.float32

    def part_of(self, result: Array, extent: Extent) -> Array:
        """Return the part of a result of the image that this member computes."""
        return core_view(extent, result) if self.patch is None else result[self.patch]
