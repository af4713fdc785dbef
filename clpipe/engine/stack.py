"""Stacks: small images and patches of one plan, which go through a device in common launches.

A launch costs a few microseconds on the host and leaves a GPU empty where the image is small. The
members of a stack are launched together, each with its own values, in buffers that hold all of
them one behind the other; each has the bits that it has alone.
"""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np

from clpipe.base.types import Array
from clpipe.engine.bindings import slot_buffer, step_buffer
from clpipe.engine.buffers import copy_encoded, copy_plane, core_of
from clpipe.engine.calls import index_space
from clpipe.engine.codegen import Kernel
from clpipe.engine.extents import Extent
from clpipe.engine.flow import DeviceTile, Flow, ImageTask, OnTheWay
from clpipe.engine.ir import Launch
from clpipe.engine.stack_kernels import Member, arguments_of
from clpipe.engine.tiles import Tiling, buffer_sizes
from clpipe.engine.work_items import round_up

ALIGNMENT = 4096  # bytes; members begin at memory pages, as buffers do

# Bytes of the buffers of a stack, by whether the device works in the host's memory. A CPU does
# images of 128x128 pixels twice as fast in stacks as alone and 256x256 a third faster, but loses a
# tenth with 512x512, which leave its cache between two launches.
STACK_BYTES = {True: 2**24, False: 2**29}
FEWEST = 4  # members, or images are so large that launches are few


@dataclass(frozen=True)
class StackKernel:
    """A kernel over a stack, compiled."""

    kernel: Kernel
    compiled: Any


@dataclass(frozen=True)
class Placed(Member):
    """A member of a stack: an image, or a patch of one by its number."""

    task: ImageTask
    patch: int | None

    def room(self, result: Array, extent: Extent) -> Array:
        """Where what it makes belongs in its image's result."""
        return core_of(extent, result) if self.patch is None else result[self.patch]


@dataclass
class Stack(OnTheWay):
    """Members on their way together.

    Args:
        members: the members, of one plan but for the scales of its resamplings.
        kernels: of the plan's launches.
        borders: those that fill the borders of what a launch has written.
        strides: bytes from a member to the next, in each buffer.
    """

    members: Sequence[Placed]
    kernels: Sequence[StackKernel]
    borders: Callable[[Launch], Iterable[StackKernel]]
    strides: dict[str, int]

    @property
    def sizes(self) -> dict[str, int]:
        """The bytes of its buffers."""
        return {name: stride * len(self.members) for name, stride in self.strides.items()}


def members_of(task: ImageTask, tiling: Tiling) -> list[Placed] | None:
    """An image, or its patches, as members of a stack.

    None where it needs launches of its own: it goes through in tiles or more than one phase, or
    somebody asks how long it took, or for results in a certain place or not at all.
    """
    options = task.options
    if len(tiling.phases) > 1 or task.plan.incremental or not options.download:
        return None
    if options.timings is not None or options.into is not None:
        return None
    if tiling.patches:
        return [Placed(e, task.bind, task, number) for number, e in enumerate(tiling.patches)]
    whole = len(tiling.tiles) == 1
    return [Placed(tiling.tiles[0], task.bind, task, None)] if whole else None


def cut(
    members: Sequence[Placed], in_place: bool, memory: int, largest: int, ends: int
) -> list[tuple[Sequence[Placed], dict[str, int]]] | None:
    """Members as stacks that fit into memory, with the strides of their buffers.

    None where they do not fit several at a time, or some have nothing to do where others have.

    Args:
        members: all of one plan.
        in_place: whether the device works in the host's memory.
        memory: bytes that all buffers together may take.
        largest: bytes that one may take.
        ends: how many sources and results there are at a time.
    """
    strides: dict[str, int] = {}
    for extents, plan in {m.extents: m.task.plan for m in members}.items():
        for name, size in buffer_sizes(plan, extents, ends).items():
            strides[name] = max(round_up(size, ALIGNMENT), strides.get(name, 0))
    if len({tuple(extent.is_empty for extent in m.extents) for m in members}) > 1:
        return None
    allowed = min(STACK_BYTES[in_place], memory)
    count = min(allowed // sum(strides.values()), largest // max(strides.values()))
    if count < FEWEST:
        return None
    parts = [members[first : first + count] for first in range(0, len(members), count)]
    return [(part, strides) for part in parts]


def start(flow: Flow, stack: Stack, memory: int) -> None:
    """Enqueue all of a stack, while buffers take no more than ``memory`` bytes."""
    flow.forget()
    flow.make_room(stack.sizes, memory)
    flow.make_way()
    plan, strides = stack.members[0].task.plan, stack.strides
    source, events = flow.transfers.upload_all(
        [pixels_of(member) for member in stack.members],
        np.float16 if plan.half else np.float32,
        strides["src0"],
    )
    stack.events += [("upload", event) for event in events]
    size = strides["dst0"] * len(stack.members) if plan.encoded else 0
    ends = {"src": source, "dst": flow.transfers.target(size, None)}
    wait = [*events, *flow.after_reads()]
    last = launch(flow, stack, ends, list(wait))
    sent = DeviceTile(stack, [*wait, *last], [])
    fetch(flow, stack, sent, ends, last)
    flow.push(sent)


def pixels_of(member: Placed) -> Array:
    """The pixels of the source that a member stores."""
    task, box = member.task, member.extents[0].stored
    pixels = task.source[box.top : box.bottom, box.left : box.right]
    return pixels.transpose(2, 0, 1) if task.plan.planar else pixels


def launch(flow: Flow, stack: Stack, ends: dict[str, Any], wait: list[Any]) -> list[Any]:
    """Launch the kernels of a stack, the first after events; the last one's event."""
    import pyopencl as cl

    members, last = stack.members, wait
    buffers = {**flow.pool.buffers, **ends}
    strides = stack.strides | {"src": stack.strides["src0"], "dst": stack.strides.get("dst0", 0)}
    for each in stack.kernels:
        step = each.kernel.launch
        extents = {member.extents[step.level] for member in members}
        if any(extent.is_empty for extent in extents):
            continue
        kernels = [each]
        if isinstance(step, Launch) and (step.has_period or any(e.is_small for e in extents)):
            kernels += stack.borders(step)
        for number, (kernel, compiled) in enumerate((k.kernel, k.compiled) for k in kernels):
            spaces = [index_space(kernel, extent) for extent in extents]
            across = [max(sides) for sides in zip(*(space for space, _ in spaces), strict=True)]
            local = spaces[0][1]
            ones = [1] * (2 - len(across))
            given = kernel.parameters, step.level, buffers, strides, members
            # Held until it is enqueued, since what a kernel is given holds no buffer.
            arguments = arguments_of(*given, flow.table, flow.new_table)
            compiled.set_args(*arguments)
            event = cl.enqueue_nd_range_kernel(
                flow.queue,
                compiled,
                (*across, *ones, len(members)),
                (*local, *ones, 1),
                wait_for=wait or None,
            )
            wait = []
            if not number:  # nothing waits for borders
                stack.events.append((step.name, event))
                last = [event]
    return last


def fetch(
    flow: Flow, stack: Stack, sent: DeviceTile, ends: dict[str, Any], after: list[Any]
) -> None:
    """Fetch the results of all members."""
    members, strides, buffers = stack.members, stack.strides, flow.pool.buffers
    plan, first = members[0].task.plan, members[0]

    def parts(name: str, buffer: Any, stride: int) -> list[Array]:
        whole = flow.fetch(sent, name, buffer, stride * len(members), after)
        return [whole[n * stride : (n + 1) * stride] for n in range(len(members))]

    if plan.encoded and not first.extents[-1].core.is_empty:
        channels = len(plan.encoded.channels)
        for member, part in zip(members, parts("dst", ends["dst"], strides["dst0"]), strict=True):
            extent, encoded = member.extents[-1], member.task.output.encoded
            assert encoded is not None
            pixels = part[: extent.stored.width * extent.stored.height * channels]
            room = member.room(encoded, extent)
            sent.copies.append(partial(copy_encoded, extent, pixels, room))
    for number in first.task.output.images:
        level = plan.level_of(number)
        if first.extents[level].core.is_empty:
            continue
        for channel, slot in enumerate(plan.slots[number]):
            name = slot_buffer(slot)
            found = parts(name, buffers[name], strides[name])
            for member, part in zip(members, found, strict=True):
                extent = member.extents[level]
                room = member.room(member.task.output.images[number], extent)
                plane = part.view(np.float32)
                sent.copies.append(partial(copy_plane, extent, plane, room, channel))
    for step in first.task.output.estimates:
        name = step_buffer("estimates", step)
        for member, part in zip(members, parts(name, buffers[name], strides[name]), strict=True):
            values = member.task.output.estimates[step]
            sent.copies.append(partial(np.copyto, values, part[: values.nbytes].view(values.dtype)))
