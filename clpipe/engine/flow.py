"""Stacks in flight on a device: commands that are enqueued, and results that are yet to be fetched.

A stack is sent, launched and fetched. It has landed when its results are in the host's arrays. An
image that is too large is processed in tiles, once in each phase. Each tile is a stack of one.
Several stacks may be in flight together.
"""

from collections import deque
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
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
from clpipe.engine.launch_cache import LaunchCache
from clpipe.engine.stack import Call, Stack
from clpipe.engine.tiles import Phase, Tiling, source_bytes
from clpipe.engine.transfers import InPlace, Staged
from clpipe.engine.work import Member, Work

ONE = np.ones(1, np.uint32)  # before the first row, so that no offset is 0
TABLES = 1 << 26  # bytes of arrays that are kept on the device, at most 64 arrays


def room_of_table(buffer: Any) -> int:
    """Return a buffer's share of :data:`TABLES`: its bytes, but at least 1/64 and at most all."""
    return min(max(buffer.size, TABLES // 64), TABLES)


@dataclass
class Flight:
    """Stacks that were enqueued together and are in flight.

    Attributes:
        events: the names and events of launches and transfers.
        stacks_left: the number of stacks that have not landed.
        error: the first error of a stack that has landed.
    """

    events: list[tuple[str, Any]] = field(default_factory=list)
    stacks_left: int = 0
    error: Exception | None = None


@dataclass(frozen=True)
class Sent:
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
        self._in_place = alignment is not None
        self.queue = self.new_queue()
        self.pool = Pool(self.new_buffer)
        self.transfers: InPlace | Staged = (
            InPlace(cl, self.queue, alignment)
            if alignment
            else Staged(cl, self.queue, self.new_queue, self.pool)
        )
        self._tables: BoundedCache[Any] = BoundedCache(TABLES, room_of_table)
        self._sent: deque[Sent] = deque()
        self._reads: list[Any] = []  # events of fetches from buffers that the next stack writes to
        self._launch_cache = LaunchCache()

    def new_queue(self) -> Any:
        """Return a queue that executes commands in order, and times them."""
        profiling = self._cl.command_queue_properties.PROFILING_ENABLE
        return self._cl.CommandQueue(self.context, properties=profiling)

    def new_buffer(self, size: int) -> Any:
        """Return a buffer on the device, or in host memory if the device uses it directly.

        PoCL would allocate its own memory at the first launch, and crash if there is too little.
        """
        flags = self._cl.mem_flags
        if not self._in_place:
            return self._cl.Buffer(self.context, flags.READ_WRITE, size)
        room = aligned_empty((size,), np.uint8)
        return self._cl.Buffer(self.context, flags.READ_WRITE | flags.USE_HOST_PTR, hostbuf=room)

    @property
    def depth(self) -> int:
        """The number of stacks that may be in flight at a time."""
        return self.transfers.depth

    def start_alone(
        self,
        flight: Flight,
        work: Work[Any],
        tiling: Tiling,
        calls: Sequence[Call],
        borders: Callable[[Launch], Iterator[Call]],
        memory: int,
    ) -> None:
        """Enqueue one image, phase by phase, with at most ``memory`` bytes of buffers.

        For an incremental plan, launches are skipped if their results are still on the device.
        """
        known, after = self.forget(), LaunchCache()
        self.reserve(tiling.sizes, memory)
        is_whole = len(tiling.tiles) == 1 and not tiling.patches
        if work.plan.incremental and is_whole:
            given = work.source, work.options.unchanged, tiling.tiles[0], work.bind
            numbers, after = known.next(calls, self.pool, *given)
            tiling = replace(tiling, phases=(Phase((), numbers, ()),))

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
                self._send(flight, stack(place, extents, phase.each, phase))
            self._launch(flight, stack(0, tiles[0], phase.last, phase), {}, [])
        self._launch_cache = after

    def start(self, flight: Flight, stack: Stack, sizes: Mapping[str, int], memory: int) -> None:
        """Enqueue a stack that needs buffers of these sizes; all take at most ``memory`` bytes."""
        self.forget()
        self.reserve(sizes, memory)
        self._send(flight, stack)

    def forget(self) -> LaunchCache:
        """Return the launch cache, and start an empty one, because buffers will be overwritten."""
        known, self._launch_cache = self._launch_cache, LaunchCache()
        return known

    def reserve(self, sizes: Mapping[str, int], memory: int) -> None:
        """Allocate buffers of these sizes (bytes by name), with at most ``memory`` bytes in all."""
        needs = self.transfers.needs(sizes)
        if not self.pool.has(needs, memory):
            self.drain()  # releasing a buffer frees its host memory, even if a command uses it
        self.pool.reserve(needs, memory)

    def _send(self, flight: Flight, stack: Stack) -> None:
        """Send a stack's pixels if a kernel reads them, launch its kernels, and fetch the results.

        If more than :attr:`depth` stacks would be in flight, this first waits for the oldest.
        """
        while len(self._sent) >= self.depth:
            self._land()
        first, members = stack.members[0], stack.members
        work, is_whole = first.work, first.is_whole and len(members) == 1
        reads = any(call.reads_source for call in stack.calls)
        source, wait = self._upload(flight, stack, is_whole) if reads else (None, [])
        whole = work.output.encoded if stack.fetches and is_whole else None
        last, size = members[-1].extents[-1].stored, 0
        if work.plan.encoded:
            size = stack.strides.get("dst", 0) * (len(members) - 1)
            size += last.width * last.height * len(work.plan.encoded.channels)
        ends = {"src": source, "dst": self.transfers.target(size, whole)}
        wait = [*wait, *self._reads]
        self._reads = []
        done = self._launch(flight, stack, ends, wait)
        sent = Sent(flight, [*wait, *done], [])
        if stack.fetches:
            self._fetch_results(sent, stack, ends, done)
        flight.stacks_left += 1
        self._sent.append(sent)
        self.transfers.flush()

    @CpuTimer("upload")
    def _upload(self, flight: Flight, stack: Stack, is_whole: bool) -> tuple[Any, list[Any]]:
        """Send the source pixels of a stack's members, unless they are on the device already."""
        first, members = stack.members[0], stack.members
        options, source = first.work.options, first.work.source
        is_same = is_whole and (options.unchanged or not options.download)
        if is_same and (sent := self.transfers.again(source)):
            return sent
        if len(members) > 1:
            pixels = [member.pixels for member in members]
            sent = self.transfers.upload_all(pixels, first.dtype, stack.strides["src"])
        else:
            size = source_bytes(first.work.plan, first.extents[0])
            sent = self.transfers.upload(source, first.pixels, first.dtype, size)
        flight.events += [("upload", event) for event in sent[1]]
        return sent

    def _launch(
        self, flight: Flight, stack: Stack, ends: Mapping[str, Any], wait: list[Any]
    ) -> list[Any]:
        """Launch the kernels of a stack, the first one after the events ``wait``.

        Returns:
            The event of the last kernel; ``wait`` if there is none.
        """
        buffers = {**self.pool.buffers, **ends}
        launches = list(stack.launches())
        if not launches:
            return wait
        asked = [value for call, *_ in launches for value in call.values]
        values = [member.work.bind(asked) for member in stack.members]
        given, first = [], 0
        for call, *_ in launches:
            end = first + len(call.values)
            own = [each[first:end] for each in values]
            given.append(call.table(stack, own, buffers, self.table, self.new_table))
            first = end
        numbers = self.new_table(np.concatenate([ONE, *(rows.reshape(-1) for rows, _ in given)]))
        offset, done = ONE.size, wait
        for (call, across, local), (rows, pointers) in zip(launches, given, strict=True):
            call.compiled.set_args(numbers, *pointers)
            event = self._cl.enqueue_nd_range_kernel(
                self.queue, call.compiled, across, local, (0, 0, offset), wait_for=wait or None
            )
            offset, wait = offset + rows.size, []
            if not isinstance(call.kernel.launch, Border):  # nothing waits for borders
                flight.events.append((call.kernel.launch.name, event))
                done = [event]
        return done

    def _fetch(self, sent: Sent, name: str, buffer: Any, size: int, after: list[Any]) -> Array:
        """Enqueue a fetch of a buffer after launches. Its bytes are valid when the stack lands."""
        array, event = self.transfers.fetch(name, buffer, size, after)
        sent.flight.events.append(("download", event))
        sent.events.append(event)
        if name != "dst":
            self._reads.append(event)
        return array

    def _fetch_results(
        self, sent: Sent, stack: Stack, ends: Mapping[str, Any], after: list[Any]
    ) -> None:
        """Enqueue the fetches of a stack's results after its launches.

        Args:
            sent: receives the copies to make when the stack lands.
            stack: the stack.
            ends: the buffers "src" and "dst", which are not in the pool.
            after: the events of the launches.
        """
        members = stack.members
        plan, output = members[0].work.plan, members[0].work.output
        buffers = {**self.pool.buffers, **ends}

        def parts(name: str, sizes: Sequence[int]) -> list[Array]:
            stride = stack.strides.get(name, 0)
            size = stride * (len(members) - 1) + sizes[-1]
            whole = self._fetch(sent, name, buffers[name], size, after)
            return [whole[n * stride : n * stride + own] for n, own in enumerate(sizes)]

        last = [member.extents[-1] for member in members]
        if plan.encoded and not last[0].core.is_empty:
            samples = len(plan.encoded.channels)
            sizes = [each.stored.width * each.stored.height * samples for each in last]
            for member, extent, pixels in zip(members, last, parts("dst", sizes), strict=True):
                encoded = member.work.output.encoded
                assert encoded is not None
                to = member.part_of(encoded, extent)
                sent.copies.append(partial(copy_encoded, extent, pixels, to))
        for number in output.images:
            own = [member.extents[plan.level_of(number)] for member in members]
            if own[0].core.is_empty:
                continue
            sizes = [extent.plane_bytes for extent in own]
            for channel, slot in enumerate(plan.slots[number]):
                found = parts(slot_buffer(slot), sizes)
                for member, extent, plane in zip(members, own, found, strict=True):
                    to = member.part_of(member.work.output.images[number], extent)
                    copy = partial(copy_plane, extent, plane.view(np.float32), to, channel)
                    sent.copies.append(copy)
        for step, values in output.estimates.items() if stack.is_last else ():
            found = parts(step_buffer("estimates", step), [values.nbytes] * len(members))
            for member, part in zip(members, found, strict=True):
                to = member.work.output.estimates[step]
                sent.copies.append(partial(np.copyto, to, part.view(to.dtype)))

    def finish(self, flight: Flight) -> None:
        """Wait until all stacks of a flight, and all stacks started before it, have landed.

        Raises:
            pyopencl.Error: a stack of the flight failed.
        """
        while flight.stacks_left:
            self._land()
        if flight.error:
            raise flight.error

    def drain(self) -> None:
        """Wait until no stack is in flight."""
        while self._sent:
            self._land()

    def abandon(self) -> None:
        """After a failure, wait for all commands in flight, drop their results, release memory."""
        self._sent.clear()
        self._reads.clear()
        for release in (
            self.queue.finish,
            self.transfers.release,
            self._tables.clear,
            self.pool.release,
        ):
            with suppress(self._cl.Error):
                release()

    def _land(self) -> None:
        """Wait for the oldest stack in flight, and copy its results. Its flight stores an error."""
        sent = self._sent.popleft()
        sent.flight.stacks_left -= 1
        try:
            if sent.events:
                with CpuTimer("kernels"):
                    self._cl.wait_for_events(sent.events)
            with CpuTimer("download"):
                for copy in sent.copies:
                    copy()
            self.transfers.done()
        except self._cl.Error as error:
            sent.flight.error = sent.flight.error or error

    def table(self, table: Array) -> Any:
        """Return a buffer with a constant array, which is uploaded once per array object."""
        return self._tables.get(Identity(table), lambda: self.new_table(table))

    def new_table(self, table: Array) -> Any:
        """Return a new buffer with a constant array."""
        flags = self._cl.mem_flags.READ_ONLY | self._cl.mem_flags.COPY_HOST_PTR
        return self._cl.Buffer(self.context, flags, hostbuf=table)
