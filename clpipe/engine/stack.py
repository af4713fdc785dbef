"""Stacks: small images and patches of one plan, which go through a device in common launches.

A launch costs a few microseconds on the host and leaves a GPU empty where the image is small. The
members of a stack are launched together, each with its own values, in buffers that hold all of
them one behind the other; each has the bits that it has alone. Their kernels have the bodies of the
plain ones, and read what differs between members from a table, see :func:`opening`.
"""

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from clpipe.base.types import Array
from clpipe.engine.bindings import Buffer, ExtentNumber, Parameter, TileNumber
from clpipe.engine.buffers import PAGE
from clpipe.engine.calls import ENDS, index_space
from clpipe.engine.flow import DeviceTile, Flow, OnTheWay
from clpipe.engine.ir import Kernel, Launch
from clpipe.engine.kernel_builder import element_of
from clpipe.engine.members import ImageTask, Member
from clpipe.engine.tiles import Tiling, buffer_sizes
from clpipe.engine.work_items import round_up

# Bytes of the buffers of a stack, by whether the device works in the host's memory. A CPU does
# images of 128x128 pixels twice as fast in stacks as alone and 256x256 a third faster, but loses a
# tenth with 512x512, which leave its cache between two launches.
STACK_BYTES = {True: 2**24, False: 2**29}
BYTES = {"uchar": 1, "half": 2, "float": 4, "uint": 4, "int4": 16, "long4": 32}
FEWEST = 4  # members, or images are so large that launches are few


@dataclass(frozen=True)
class StackKernel:
    """A kernel over a stack, compiled."""

    kernel: Kernel
    compiled: Any


@dataclass
class Stack(OnTheWay):
    """Members on their way together.

    Args:
        members: the members, of one plan but for the scales of its resamplings.
        kernels: of the plan's launches.
        borders: those that fill the borders of what a launch has written.
        strides: bytes from a member to the next, in each buffer.
    """

    members: Sequence[Member]
    kernels: Sequence[StackKernel]
    borders: Callable[[Launch], Iterable[StackKernel]]
    strides: dict[str, int]

    @property
    def sizes(self) -> dict[str, int]:
        """The bytes of its buffers in the pool."""
        count = len(self.members)
        return {name: stride * count for name, stride in self.strides.items() if name not in ENDS}


def members_of(task: ImageTask, tiling: Tiling) -> list[Member] | None:
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
        return [Member(e, task, number) for number, e in enumerate(tiling.patches)]
    whole = len(tiling.tiles) == 1
    return [Member(tiling.tiles[0], task)] if whole else None


def cut(
    members: Sequence[Member], in_place: bool, memory: int, largest: int, ends: int
) -> list[tuple[Sequence[Member], dict[str, int]]] | None:
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
            strides[name] = max(round_up(size, PAGE), strides.get(name, 0))
    together, longest = sum(strides.values()), max(strides.values())
    if len({tuple(extent.is_empty for extent in m.extents) for m in members}) > 1:
        return None
    allowed = min(STACK_BYTES[in_place], memory)
    count = min(allowed // together, largest // longest)
    strides |= {end: strides[f"{end}0"] for end in ENDS if f"{end}0" in strides}
    if count < FEWEST:
        return None
    parts = [members[first : first + count] for first in range(0, len(members), count)]
    return [(part, strides) for part in parts]


def start(flow: Flow, stack: Stack, memory: int) -> None:
    """Enqueue all of a stack, while buffers take no more than ``memory`` bytes."""
    flow.forget()
    flow.make_room(stack.sizes, memory)
    flow.make_way()
    members, strides = stack.members, stack.strides
    source, events = flow.transfers.upload_all(
        [member.pixels for member in members], members[0].dtype, strides["src"]
    )
    stack.events += [("upload", event) for event in events]
    size = strides.get("dst", 0) * len(members)
    ends = {"src": source, "dst": flow.transfers.target(size, None)}
    wait = [*events, *flow.after_reads()]
    last = launch(flow, stack, ends, list(wait))
    sent = DeviceTile(stack, [*wait, *last], [])
    flow.fetch_results(sent, members, strides, ends, last)
    flow.push(sent)


def launch(flow: Flow, stack: Stack, ends: dict[str, Any], wait: list[Any]) -> list[Any]:
    """Launch the kernels of a stack, the first after events; the last one's event."""
    import pyopencl as cl

    members, last = stack.members, wait
    buffers = {**flow.pool.buffers, **ends}
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
            given = kernel.parameters, step.level, buffers, stack.strides, members
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


def arguments_of(
    parameters: Sequence[Parameter],
    level: int,
    buffers: Mapping[str, Any],
    strides: Mapping[str, int],
    members: Sequence[Member],
    table: Callable[[Array], Any],
    new_table: Callable[[Array], Any],
) -> list[Any]:
    """The arguments of a stack's kernel, in order.

    Args:
        parameters: the plain kernel's, in order.
        level: of its launch.
        buffers: by name.
        strides: bytes from a member to the next in each buffer.
        members: of the stack.
        table: gives a buffer that holds an array, which is used again for the same object.
        new_table: gives a new one.
    """
    numbers = np.zeros((len(members), len(parameters)), np.uint32)
    pointers = []
    for place, parameter in enumerate(parameters):
        match parameter.bound:
            case Buffer(name):
                pointers.append(buffers[name])
                element = element_of(parameter)
                assert element
                numbers[:, place] = strides[name] // BYTES[element]
            case ExtentNumber(name, larger):
                of = max(level - 1, 0) if larger else level
                numbers[:, place] = [member.extents[of].numbers[name] for member in members]
            case TileNumber():
                pass  # of each the first
            case value:
                found = [member.task.bind(value) for member in members]
                if isinstance(found[0], np.ndarray):
                    array, numbers[:, place] = side_by_side(found)
                    pointers.append((table if array is found[0] else new_table)(array))
                else:
                    numbers[:, place] = np.array(found, found[0].dtype).view(np.uint32)
    return [new_table(numbers), *pointers]


def side_by_side(arrays: Sequence[Array]) -> tuple[Array, int]:
    """Arrays one behind the other, and the elements from each to the next: 0 if all are one object.

    >>> side_by_side([np.array([1, 2, 3]), np.array([4])])[0].tolist()
    [1, 2, 3, 4, 0, 0]
    """
    first = arrays[0]
    if all(array is first for array in arrays):
        return first, 0
    longest = max(array.size for array in arrays)
    both = np.zeros((len(arrays), longest), first.dtype)
    for row, array in zip(both, arrays, strict=True):
        row[: array.size] = array.reshape(-1)
    return both.reshape(-1), longest
