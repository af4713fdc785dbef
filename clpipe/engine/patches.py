"""Patches: parts of an image's result that are computed alone, each as one tile. Pure.

Like every tile, a patch is stored in whole blocks, wherever it begins. Therefore it equals the same
part of the whole result, bit for bit.
"""

from collections.abc import Mapping, Sequence
from dataclasses import replace

from clpipe.base.errors import ImageError, MemoryLimitError
from clpipe.base.memory import format_bytes
from clpipe.engine.extents import Box, enclosing
from clpipe.engine.ir import Plan
from clpipe.engine.tiles import Tiling, buffer_sizes, cutter_of, phases_of


def with_patches(
    plan: Plan, boxes: Sequence[Box], tiling: Tiling, lanes: int, memory: int, depth: int = 1
) -> Tiling:
    """Return the tiling that computes only patches of an image's result.

    Estimates from the whole image still use all of its tiles, in the phases before the last.

    Args:
        plan: the plan.
        boxes: the patches, in pixels of the results, all of one size.
        tiling: the tiling of the whole image.
        lanes: the lanes of the device.
        memory: the most bytes that all buffers together may use.
        depth: as for :func:`~clpipe.engine.tiles.tiling_of`.

    Raises:
        ImageError: a patch does not fit into the memory. For patches that run in stacks, this is
            checked later, when the stacks are made.
    """
    source = tiling.tiles[0][0]
    cutter = cutter_of(plan, source.width, source.height, lanes)
    levels = {image.level for _, image in plan.kept} | {len(cutter.whole) - 1}
    patches = tuple(cutter.patch(box, levels) for box in boxes)
    phases = phases_of(plan)
    if len(phases) == 1:  # the patches run in stacks
        return replace(tiling, phases=phases, sizes={}, patches=patches)
    sizes = dict(tiling.sizes)
    for name, size in buffer_sizes(plan, enclosing(patches), depth).items():
        sizes[name] = max(size, sizes.get(name, 0))
    check_memory(sizes, memory)
    return replace(tiling, phases=phases, sizes=sizes, patches=patches)


def check_sizes(plan: Plan, width: int, height: int) -> None:
    """Check that all images of a result have one size, which patches need.

    Raises:
        ImageError: the sizes differ.
    """
    *_, last = sizes = plan.sizes(width, height)
    for name, kept in plan.kept:
        size = sizes[kept.level]
        if size != last:
            raise ImageError(
                f"the image after {name} has {size[0]}x{size[1]} pixels, but the last image has "
                f"{last[0]}x{last[1]}. Patches need images of one size. Do not keep {name}."
            )


def check_memory(sizes: Mapping[str, int], memory: int) -> None:
    """Check that the buffers of a patch (bytes by name) fit into ``memory`` bytes.

    Raises:
        ImageError: the buffers do not fit.
    """
    if sum(sizes.values()) > memory:
        raise MemoryLimitError(
            f"a patch needs {format_bytes(sum(sizes.values()))} of device memory, but the limit is "
            f"{format_bytes(memory)}. Raise the memory limit, or use smaller patches."
        )
