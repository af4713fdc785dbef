"""The members of a pass through a device: what each stores of its source, and where results go.

A tile or a patch that goes by itself is the one member of its pass; a stack has several.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np

from clpipe.base.types import Array
from clpipe.engine.bindings import Bind
from clpipe.engine.buffers import HostImages, core_of
from clpipe.engine.extents import Extent, Extents
from clpipe.engine.ir import Plan
from clpipe.engine.options import RunOptions


@dataclass(frozen=True)
class ImageTask:
    """The work that is to be done to one image.

    Args:
        plan: the plan.
        source: the image, (height, width[, channel]).
        bind: gives the values of kernel parameters.
        output: where the results go.
        options: how, see :class:`RunOptions`.
    """

    plan: Plan
    source: Array
    bind: Bind
    output: HostImages
    options: RunOptions


@dataclass(frozen=True)
class Member:
    """A member of a pass.

    Args:
        extents: its place on each level.
        task: of its image.
        patch: which of the image's patches it is; None is the image, or a tile of it.
    """

    extents: Extents
    task: ImageTask
    patch: int | None = None

    @property
    def pixels(self) -> Array:
        """What it stores of the source, as the plan reads it."""
        box = self.extents[0].stored
        pixels = self.task.source[box.top : box.bottom, box.left : box.right]
        return pixels.transpose(2, 0, 1) if self.task.plan.planar else pixels

    @property
    def dtype(self) -> Any:
        """The type of the source's samples on the device."""
        return np.float16 if self.task.plan.half else np.float32

    def room(self, result: Array, extent: Extent) -> Array:
        """Where what it makes belongs in its image's result."""
        return core_of(extent, result) if self.patch is None else result[self.patch]
