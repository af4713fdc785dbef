"""The device memory of a plan, and the memory traffic of its launches. Pure."""

import math

from clpipe.engine.ir import AnyLaunch, Launch, Plan, Reduce, reads_of
from clpipe.engine.work_items import summed_together


def relative_pixels(plan: Plan, level: int) -> float:
    """Return the approximate number of pixels on a level per pixel of the source."""
    return math.prod(each.scale for each in plan.resamplings[:level])


def sum_bytes(lanes: int) -> float:
    """Return the bytes per pixel of the sums of an image's blocks."""
    return 16 / (lanes * summed_together(lanes) * 4)


def bytes_per_pixel(plan: Plan, lanes: int) -> float:
    """Return the device memory in bytes per pixel: source, slots, block sums, eight-bit result."""
    total = float(plan.source_bytes)
    total += sum(4 * relative_pixels(plan, min(levels)) for levels in plan.levels_of_slots)
    for launch in plan.launches:
        if isinstance(launch, Launch) and launch.sums:
            total += sum_bytes(lanes) * relative_pixels(plan, launch.level)
    encoded = len(plan.encoded.channels) if plan.encoded else 0
    return total + encoded * relative_pixels(plan, len(plan.resamplings))


def launch_bytes(plan: Plan, launch: AnyLaunch, lanes: int) -> float:
    """Return the bytes per pixel that a launch reads and writes, counting each sample once."""
    if isinstance(launch, Reduce) and not launch.op.reduction.bins:
        return sum_bytes(lanes) * relative_pixels(plan, launch.level)
    images = [read.image for read in reads_of(launch)]
    total = sum(4 * len(i.kind.channels) * relative_pixels(plan, i.level) for i in images)
    if not isinstance(launch, Launch):
        return total
    if not launch.reads:
        total += plan.source_bytes
    written = 0.0
    if launch.writes:
        written += 4 * len(launch.writes.kind.channels)
    if launch.encodes and plan.encoded:
        written += len(plan.encoded.channels)
    if launch.sums:
        written += sum_bytes(lanes)
    return total + written * relative_pixels(plan, launch.level)
