"""Parts of an image's result, made alone: each is a tile of its own. Pure.

A patch is stored from whole blocks on, as every tile is, wherever it begins. So it has the bits
that the whole result has there.
"""

from collections.abc import Mapping, Sequence
from dataclasses import replace

from clpipe.base.errors import ImageError
from clpipe.base.memory import in_words
from clpipe.engine.extents import Box, enclosing
from clpipe.engine.ir import Plan
from clpipe.engine.tiles import Tiling, buffer_sizes, cutter_of, phases_of


def with_patches(
    plan: Plan, boxes: Sequence[Box], whole: Tiling, lanes: int, memory: int, ends: int = 1
) -> Tiling:
    """The tiling that makes only parts of an image's result.

    Numbers that are estimated from the whole image are still estimated from all of its tiles, in
    the phases before the last.

    Args:
        plan: the plan.
        boxes: the parts, in pixels of the results, which are all of one size.
        whole: how the whole image goes through the plan.
        lanes: of the device.
        memory: bytes that all buffers together may take.
        ends: as for :func:`~clpipe.engine.tiles.tiling_of`.

    Raises:
        ImageError: a part does not fit into the memory; of parts that go in stacks, that is seen
            when these are made.
    """
    source = whole.tiles[0][0]
    cut = cutter_of(plan, source.width, source.height, lanes)
    levels = {image.level for _, image in plan.kept} | {len(cut.whole) - 1}
    patches = tuple(cut.patch(box, levels) for box in boxes)
    phases = phases_of(plan)
    if len(phases) == 1:  # they go in stacks
        return replace(whole, phases=phases, sizes={}, patches=patches)
    sizes = dict(whole.sizes)
    for name, size in buffer_sizes(plan, enclosing(patches), ends).items():
        sizes[name] = max(size, sizes.get(name, 0))
    check_memory(sizes, memory)
    return replace(whole, phases=phases, sizes=sizes, patches=patches)


def check_memory(sizes: Mapping[str, int], memory: int) -> None:
    """See that the buffers of a patch, bytes by name, fit into memory.

    Raises:
        ImageError: they do not.
    """
    if sum(sizes.values()) > memory:
        raise ImageError(
            f"a patch needs {in_words(sum(sizes.values()))} of device memory, but the limit is "
            f"{in_words(memory)}. Raise the memory limit, or use smaller patches."
        )
