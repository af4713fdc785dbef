"""Memory of a run: buffers on the device, and arrays on the host for the results."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from math import prod
from typing import Any

import numpy as np

from clpipe.base.types import Array
from clpipe.engine.extents import Box, Extent
from clpipe.engine.ir import Plan
from clpipe.engine.work_items import round_up
from clpipe.stage import Kind


@dataclass
class HostImages:
    """The results of a run on the host. Images of patches are (patch, height, width[, channel]).

    Attributes:
        images: float32 images by their number in the plan, (height, width[, channel]).
        encoded: the eight-bit pixels of the last image, (height, width[, channel]).
        estimates: four floats for each step that estimates numbers from the image.
    """

    images: dict[int, Array]
    encoded: Array | None
    estimates: dict[str, Array]


PAGE = 4096


def aligned_empty(shape: tuple[int, ...], dtype: Any) -> Array:
    """Return an uninitialised array that begins at a memory page, unlike NumPy's own arrays.

    >>> array = aligned_empty((3, 5), np.float32)
    >>> array.shape, array.ctypes.data % PAGE
    ((3, 5), 0)
    """
    size = prod(shape) * np.dtype(dtype).itemsize
    buffer = np.empty(size + PAGE, np.uint8)
    start = -buffer.ctypes.data % PAGE
    return buffer[start : start + size].view(dtype).reshape(shape)


def allocate_results(
    plan: Plan, width: int, height: int, into: Array | None, boxes: Sequence[Box] = ()
) -> HostImages:
    """Return uninitialised arrays for all results of a plan.

    Args:
        plan: the plan.
        width: the width of the source in pixels.
        height: its height.
        into: an array to use for the eight-bit pixels.
        boxes: the patches of the results to compute, all of one size. () computes whole images.

    Raises:
        ValueError: ``into`` has the wrong shape or type, or the patches differ in size.
    """
    shapes = {(box.height, box.width) for box in boxes}
    if len(shapes) > 1:
        raise ValueError(f"patches have the sizes {sorted(shapes)}, but all must have one size")
    sizes = plan.sizes(width, height)

    def shape(kind: Kind, level: int) -> tuple[int, ...]:
        size = (len(boxes), *min(shapes)) if shapes else sizes[level][::-1]
        return size if len(kind.channels) == 1 else (*size, len(kind.channels))

    images = [image for _, image in plan.kept] + ([plan.final] if plan.final else [])
    encoded = None
    if plan.encoded:
        expected_shape = shape(plan.encoded, len(sizes) - 1)
        encoded = aligned_empty(expected_shape, np.uint8) if into is None else into
        if encoded.shape != expected_shape or encoded.dtype != np.uint8:
            raise ValueError(
                f"into has shape {encoded.shape} and type {encoded.dtype}, but the result has "
                f"shape {expected_shape} and type uint8"
            )
    return HostImages(
        images={i.number: np.empty(shape(i.kind, i.level), np.float32) for i in images},
        encoded=encoded,
        estimates={step: np.empty(4, np.float32) for step in plan.estimates},
    )


def core_view(extent: Extent, image: Array) -> Array:
    """Return the part of an image, (height, width[, channel]), that a tile computes."""
    core = extent.core
    return image[core.top : core.bottom, core.left : core.right]


def copy_encoded(extent: Extent, pixels: Array, target: Array) -> None:
    """Copy the core of a tile's eight-bit pixels, unless both arrays share memory."""
    if not np.may_share_memory(pixels, target):
        core, stored = extent.core, extent.stored
        part = pixels.reshape(stored.height, stored.width, *target.shape[2:])
        rows = slice(core.top - stored.top, core.bottom - stored.top)
        columns = slice(core.left - stored.left, core.right - stored.left)
        target[:] = part[rows, columns]


def copy_plane(extent: Extent, plane: Array, target: Array, channel: int) -> None:
    """Copy the core of a tile's plane to a channel of an image, (height, width[, channel])."""
    core, stored, border = extent.core, extent.stored, extent.border
    height = extent.padded_height + 2 * border
    top = border + core.top - stored.top
    left = round_up(border, extent.lanes) + core.left - stored.left
    rows = plane[: height * extent.pitch].reshape(height, extent.pitch)
    image = target if target.ndim == 2 else target[..., channel]
    image[:] = rows[top : top + core.height, left : left + core.width]


def is_planar(image: Array) -> bool:
    """Return whether the channels of an image are stored as consecutive planes.

    >>> is_planar(np.zeros((3, 4, 5)).transpose(1, 2, 0)), is_planar(np.zeros((4, 5, 3)))
    (True, False)
    """
    if image.ndim != 3 or image.flags.c_contiguous:
        return False
    return image.transpose(2, 0, 1).flags.c_contiguous


def crop_patches(image: Array, boxes: Sequence[Box]) -> Array:
    """Return parts of an image, all of one size, as (patch, height, width[, channel])."""
    return np.stack([image[box.top : box.bottom, box.left : box.right] for box in boxes])


class Pool:
    """Device buffers by name, which later images reuse if they are large enough."""

    def __init__(self, allocate: Callable[[int], Any]) -> None:
        self._allocate = allocate
        self.buffers: dict[str, Any] = {}
        self._sizes: dict[str, int] = {}  # querying a buffer's size is slower

    def has(self, sizes: Mapping[str, int], memory: int) -> bool:
        """Return whether :meth:`reserve` would neither release nor allocate a buffer."""
        allocated = self._sizes
        all_present = all(
            name in allocated and allocated[name] >= size for name, size in sizes.items()
        )
        return all_present and self.bytes <= memory

    def reserve(self, sizes: Mapping[str, int], memory: int) -> None:
        """Allocate buffers of at least these sizes (bytes by name), if they are missing.

        Buffers that only earlier images needed are kept as long as all buffers fit into ``memory``
        bytes.
        """
        if self.has(sizes, memory):
            return
        reusable = {name: size for name, size in self._sizes.items() if size >= sizes.get(name, 0)}
        missing = sum(size for name, size in sizes.items() if name not in reusable)
        for can_drop in (lambda name, _: name not in sizes, lambda name, size: size > sizes[name]):
            if sum(reusable.values()) + missing > memory:
                dropped = [name for name, size in reusable.items() if can_drop(name, size)]
                missing += sum(sizes.get(name, 0) for name in dropped)
                reusable = {name: size for name, size in reusable.items() if name not in dropped}
        for name in self.buffers.keys() - reusable.keys():
            self.buffers.pop(name).release()
            del self._sizes[name]
        for name, size in sizes.items():
            if name not in reusable:
                self.buffers[name], self._sizes[name] = self._allocate(size), size

    @property
    def bytes(self) -> int:
        """The size of all buffers together, in bytes."""
        return sum(self._sizes.values())

    def release(self) -> None:
        """Release all buffers."""
        buffers, self.buffers, self._sizes = self.buffers, {}, {}
        for buffer in buffers.values():
            buffer.release()
