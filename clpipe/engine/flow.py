"""Stacks in flight on a device: commands that are enqueued, and results that are yet to be fetched.

The source pixels of a stack are uploaded, its kernels are launched, and its results are fetched.
The stack is finished when its results are in the host's arrays. An image that is too large is
processed in tiles, once in each phase. Each tile is a stack of one. Several stacks may be in flight
together.
"""

from collections import deque
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from functools import partial
from typing import Any

import numpy as np

from clpipe.base.cache import BoundedCache, Identity
from clpipe.base.cpu_time import CpuTimer
from clpipe.base.types import Array
from clpipe.engine.bindings import slot_buffer, step_buffer
from clpipe.engine.buffers import Pool, aligned_empty, copy_encoded, copy_plane
from clpipe.engine.extents import Extents
from clpipe.engine.ir import Border, Launch
from clpipe.engine.stack import Call, Stack
from clpipe.engine.tiles import Phase, Tiling, source_bytes
from clpipe.engine.transfers import Staged, ZeroCopy
from clpipe.engine.work import Member, Work

OFFSET_PADDING = np.ones(1, np.uint32)  # before the first row, so that no offset is 0
MAX_TABLE_BYTES = 1 << 26  # bytes of arrays that are kept on the device, at most 64 arrays


def table_cost(buffer: Any) -> int:
    """Return a buffer's part of :data:`MAX_TABLE_BYTES`: its bytes, within 1/64 and all."""
    return min(max(buffer.size, MAX_TABLE_BYTES // 64), MAX_TABLE_BYTES)


@dataclass
class Flight:
    """Stacks that were enqueued together and are in flight.

    Attributes:
        events: the names and events of launches and transfers.
        pending: the number of stacks that are not finished.
        error: the first error of a finished stack.
    """

    events: list[tuple[str, Any]] = field(default_factory=list)
    pending: int = 0
    error: Exception | None = None


@dataclass(frozen=True)
class StackInFlight:
    """A stack in flight: the events to wait for, and the copies to make after them."""

    flight: Flight
    events: list[Any]
    copies: list[Callable[[], None]]


class Flow:
    """The queues and buffers of a context, which all images share.

    Args:
        context: the ``pyopencl.Context``.
        alignment: the required alignment of host memory in bytes, if the device uses host memory
            directly; else None.
    """

    def __init__(self, context: Any, alignment: int | None) -> None:
        import pyopencl as cl

        self._cl = cl
        self.context = context
        self._zero_copy = alignment is not None
        self.queue = self.new_queue()
        self.pool = Pool(self.new_buffer)
        self.transfers: ZeroCopy | Staged = (
            ZeroCopy(cl, self.queue, alignment)
            if alignment
            else Staged(cl, self.queue, self.new_queue, self.pool)
        )
        self._tables: BoundedCache[Any] = BoundedCache(MAX_TABLE_BYTES, table_cost)
        self._in_flight: deque[StackInFlight] = deque()
        self._fetch_events: list[
            Any
        ] = []  # events of fetches from buffers that the next stack writes to

    def new_queue(self) -> Any:
        """Return a queue that executes commands in order, and times them."""
        profiling = self._cl.command_queue_properties.PROFILING_ENABLE
        return self._cl.CommandQueue(self.context, properties=profiling)

    def new_buffer(self, size: int) -> Any:
        """Return a buffer on the device, or in host memory if the device uses it directly.

        PoCL would allocate its own memory at the first launch, and crash if there is too little.
        """
        flags = self._cl.mem_flags
        if not self._zero_copy:
            return self._cl.Buffer(self.context, flags.READ_WRITE, size)
        memory = aligned_empty((size,), np.uint8)
        return self._cl.Buffer(self.context, flags.READ_WRITE | flags.USE_HOST_PTR, hostbuf=memory)

    @property
    def depth(self) -> int:
        """The number of stacks that may be in flight at a time."""
        return self.transfers.depth

    def start_tiled(
        self,
        flight: Flight,
        work: Work[Any],
        tiling: Tiling,
        calls: Sequence[Call],
        borders: Callable[[Launch], Iterator[Call]],
        memory: int,
    ) -> None:
        """Enqueue one image, phase by phase, with at most ``memory`` bytes of buffers."""
        self.reserve(tiling.sizes, memory)
        is_whole = len(tiling.tiles) == 1 and not tiling.patches

        def stack(place: int, extents: Extents, numbers: Sequence[int], phase: Phase) -> Stack:
            is_patch = tiling.patches and phase is tiling.phases[-1]
            member = Member(extents, work, place if is_patch else None, is_whole)
            return Stack(
                [member],
                [calls[number] for number in numbers],
                borders,
                {},
                place,
                fetches=work.options.download and phase is tiling.phases[-1],
                is_last=place == len(tiling.patches or tiling.tiles) - 1,
            )

        for phase in tiling.phases:
            tiles = tiling.tiles_of(phase)
            self._launch(flight, stack(0, tiles[0], phase.first, phase), {}, [])
            for place, extents in enumerate(tiles):
                self._submit(flight, stack(place, extents, phase.each, phase))
            self._launch(flight, stack(0, tiles[0], phase.last, phase), {}, [])

    def start(self, flight: Flight, stack: Stack, sizes: Mapping[str, int], memory: int) -> None:
        """Enqueue a stack that needs buffers of these sizes; all take at most ``memory`` bytes."""
        member = stack.members[0]
        if state := member.work.options.state:
            state.begin_frame(self, member.work.plan, member.extents)
            sizes = {name: size for name, size in sizes.items() if name not in state.buffers}
            memory -= state.bytes
        self.reserve(sizes, memory)
        self._submit(flight, stack)

    def reserve(self, sizes: Mapping[str, int], memory: int) -> None:
        """Allocate buffers of these sizes (bytes by name), with at most ``memory`` bytes in all."""
        needs = self.transfers.needs(sizes)
        if not self.pool.has(needs, memory):
            self.drain()  # releasing a buffer frees its host memory, even if a command uses it
        self.pool.reserve(needs, memory)

    def _submit(self, flight: Flight, stack: Stack) -> None:
        """Upload a stack's pixels if a kernel reads them, launch its kernels, fetch its results.

        If more than :attr:`depth` stacks would be in flight, this first waits for the oldest.
        """
        while len(self._in_flight) >= self.depth:
            self._finish_oldest()
        first, members = stack.members[0], stack.members
        work, is_whole = first.work, first.is_whole and len(members) == 1
        reads = any(call.reads_source for call in stack.calls)
        source, wait = self._upload(flight, stack, is_whole) if reads else (None, [])
        target = work.output.encoded if stack.fetches and is_whole else None
        last, size = members[-1].extents[-1].stored, 0
        if work.plan.encoded:
            size = stack.strides.get("dst", 0) * (len(members) - 1)
            size += last.width * last.height * len(work.plan.encoded.channels)
        io_buffers = {"src": source, "dst": self.transfers.target(size, target)}
        wait = [*wait, *self._fetch_events]
        self._fetch_events = []
        events = self._launch(flight, stack, io_buffers, wait)
        in_flight = StackInFlight(flight, [*wait, *events], [])
        if stack.fetches:
            self._fetch_results(in_flight, stack, io_buffers, events)
        flight.pending += 1
        self._in_flight.append(in_flight)
        self.transfers.flush()

    @CpuTimer("upload")
    def _upload(self, flight: Flight, stack: Stack, is_whole: bool) -> tuple[Any, list[Any]]:
        """Upload the source pixels of a stack's members, unless they are on the device already."""
        first, members = stack.members[0], stack.members
        options, source = first.work.options, first.work.source
        is_same = is_whole and (options.unchanged or not options.download)
        if is_same and (sent := self.transfers.reuse_upload(source)):
            return sent
        if len(members) > 1:
            pixels = [member.pixels for member in members]
            sent = self.transfers.upload_all(pixels, first.dtype, stack.strides["src"])
        else:
            size = source_bytes(first.work.plan, first.extents[0])
            sent = self.transfers.upload(source, first.pixels, first.dtype, size)
        flight.events += [("upload", event) for event in sent[1]]
        return sent

    def _buffers(self, stack: Stack, io_buffers: Mapping[str, Any]) -> dict[str, Any]:
        """Return all buffers that a stack uses, by name."""
        state = stack.members[0].work.options.state
        return {**self.pool.buffers, **(state.buffers if state else {}), **io_buffers}

    def _launch(
        self, flight: Flight, stack: Stack, io_buffers: Mapping[str, Any], wait: list[Any]
    ) -> list[Any]:
        """Launch the kernels of a stack, the first one after the events ``wait``.

        Returns:
            The event of the last kernel; ``wait`` if there is none.
        """
        buffers = self._buffers(stack, io_buffers)
        launches = list(stack.launches())
        if not launches:
            return wait
        requested = [value for call, *_ in launches for value in call.values]
        values = [member.work.bind(requested) for member in stack.members]
        tables, first = [], 0
        for call, *_ in launches:
            end = first + len(call.values)
            call_values = [each[first:end] for each in values]
            tables.append(call.table(stack, call_values, buffers, self.table, self.new_table))
            first = end
        numbers = self.new_table(
            np.concatenate([OFFSET_PADDING, *(rows.reshape(-1) for rows, _ in tables)])
        )
        offset, events = OFFSET_PADDING.size, wait
        for (call, global_size, local_size), (rows, pointers) in zip(launches, tables, strict=True):
            call.compiled.set_args(numbers, *pointers)
            event = self._cl.enqueue_nd_range_kernel(
                self.queue,
                call.compiled,
                global_size,
                local_size,
                (0, 0, offset),
                wait_for=wait or None,
            )
            offset, wait = offset + rows.size, []
            if not isinstance(call.kernel.launch, Border):  # nothing waits for borders
                flight.events.append((call.kernel.launch.name, event))
                events = [event]
        return events

    def _fetch(
        self, stack: StackInFlight, name: str, buffer: Any, size: int, after: list[Any]
    ) -> Array:
        """Enqueue a fetch of a buffer. Its bytes are valid when the stack finishes."""
        array, event = self.transfers.fetch(name, buffer, size, after)
        stack.flight.events.append(("download", event))
        stack.events.append(event)
        if name != "dst":
            self._fetch_events.append(event)
        return array

    def _fetch_results(
        self,
        in_flight: StackInFlight,
        stack: Stack,
        io_buffers: Mapping[str, Any],
        after: list[Any],
    ) -> None:
        """Enqueue the fetches of a stack's results after its launches.

        Args:
            in_flight: receives the copies to make when the stack finishes.
            stack: the stack.
            io_buffers: the buffers "src" and "dst", which are not in the pool.
            after: the events of the launches.
        """
        members = stack.members
        plan, output = members[0].work.plan, members[0].work.output
        buffers = self._buffers(stack, io_buffers)

        def parts(name: str, sizes: Sequence[int]) -> list[Array]:
            stride = stack.strides.get(name, 0)
            size = stride * (len(members) - 1) + sizes[-1]
            data = self._fetch(in_flight, name, buffers[name], size, after)
            return [data[n * stride : n * stride + length] for n, length in enumerate(sizes)]

        last = [member.extents[-1] for member in members]
        if plan.encoded and not last[0].core.is_empty:
            samples = len(plan.encoded.channels)
            sizes = [each.stored.width * each.stored.height * samples for each in last]
            for member, extent, pixels in zip(members, last, parts("dst", sizes), strict=True):
                encoded = member.work.output.encoded
                assert encoded is not None
                target = member.part_of(encoded, extent)
                in_flight.copies.append(partial(copy_encoded, extent, pixels, target))
        for number in output.images:
            extents = [member.extents[plan.level_of(number)] for member in members]
            if extents[0].core.is_empty:
                continue
            sizes = [extent.plane_bytes for extent in extents]
            for channel, slot in enumerate(plan.slots[number]):
                planes = parts(slot_buffer(slot), sizes)
                for member, extent, plane in zip(members, extents, planes, strict=True):
                    target = member.part_of(member.work.output.images[number], extent)
                    copy = partial(copy_plane, extent, plane.view(np.float32), target, channel)
                    in_flight.copies.append(copy)
        for step, values in output.estimates.items() if stack.is_last else ():
            planes = parts(step_buffer("estimates", step), [values.nbytes] * len(members))
            for member, part in zip(members, planes, strict=True):
                target = member.work.output.estimates[step]
                in_flight.copies.append(partial(np.copyto, target, part.view(target.dtype)))

    def finish(self, flight: Flight) -> None:
        """Wait until all stacks of a flight, and all stacks started before it, are finished.

        Raises:
            pyopencl.Error: a stack of the flight failed.
        """
        while flight.pending:
            self._finish_oldest()
        if flight.error:
            raise flight.error

    def drain(self) -> None:
        """Wait until no stack is in flight."""
        while self._in_flight:
            self._finish_oldest()

    def abandon(self) -> None:
        """After a failure, wait for all commands in flight, drop their results, release memory."""
        self._in_flight.clear()
        self._fetch_events.clear()
        for release in (
            self.queue.finish,
            self.transfers.release,
            self._tables.clear,
            self.pool.release,
        ):
            with suppress(self._cl.Error):
                release()

    def _finish_oldest(self) -> None:
        """Wait for the oldest stack in flight, and copy its results. Its flight stores an error."""
        stack = self._in_flight.popleft()
        stack.flight.pending -= 1
        try:
            if stack.events:
                with CpuTimer("kernels"):
                    self._cl.wait_for_events(stack.events)
            with CpuTimer("download"):
                for copy in stack.copies:
                    copy()
            self.transfers.done()
        except self._cl.Error as error:
            stack.flight.error = stack.flight.error or error

    def table(self, table: Array) -> Any:
        """Return a buffer with a constant array, which is uploaded once per array object."""
        return self._tables.get(Identity(table), lambda: self.new_table(table))

    def new_table(self, table: Array) -> Any:
        """Return a new buffer with a constant array."""
        flags = self._cl.mem_flags.READ_ONLY | self._cl.mem_flags.COPY_HOST_PTR
        return self._cl.Buffer(self.context, flags, hostbuf=table)
