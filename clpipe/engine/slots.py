"""Slots: the assignment of buffers to the planes of a plan's images, by liveness. Pure."""

from collections.abc import Sequence

from clpipe.engine.ir import AnyLaunch, Image, Launch, reads_of


def assign_slots(
    launches: Sequence[AnyLaunch],
    images: Sequence[Image],
    pinned: set[int],
    stored: Sequence[Image] = (),
) -> tuple[tuple[tuple[int, ...], ...], int]:
    """Assign slots to the planes of every image, by liveness.

    Args:
        launches: the launches, in order.
        images: the images that the launches write.
        pinned: the numbers of images whose slots are never reused: results, and images that stay on
            the device.
        stored: pinned images that no launch writes, because they are on the device already.

    Returns:
        The slots of each image, by its number, and the number of slots.
    """
    last_use = {
        read.image.number: i for i, launch in enumerate(launches) for read in reads_of(launch)
    }
    slots: dict[int, tuple[int, ...]] = {}
    free: list[int] = []
    count = 0
    for image in stored:
        slots[image.number] = tuple(range(count, count + len(image.kind.channels)))
        count += len(image.kind.channels)
    for i, launch in enumerate(launches):
        if isinstance(launch, Launch) and launch.writes:
            planes = len(launch.writes.kind.channels)
            while len(free) < planes:
                free.append(count)
                count += 1
            slots[launch.writes.number] = tuple(free[:planes])
            del free[:planes]
        for read in {read.image.number for read in reads_of(launch)}:
            if last_use[read] == i and read not in pinned:
                free.extend(slots[read])
    return tuple(slots.get(image.number, ()) for image in images), count
