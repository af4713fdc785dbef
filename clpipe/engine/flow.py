"""Images on their way through a device: what is enqueued, and what is still to be fetched.

An image goes through in tiles, once in each phase. A tile is sent, launched and fetched; it has
landed when its results are in the host's arrays. Tiles of one image or of neighbours may be on the
way together.
"""

from collections import deque
from collections.abc import Callable, Iterable, Mapping, Sequence
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
from clpipe.engine.calls import Call, index_space
from clpipe.engine.extents import Extents
from clpipe.engine.ir import Launch
from clpipe.engine.launch_cache import LaunchCache
from clpipe.engine.members import ImageTask, Member
from clpipe.engine.tiles import Phase, Tiling, source_bytes
from clpipe.engine.transfers import InPlace, Staged

TABLES = 1 << 26  # bytes of arrays that are kept on the device, 64 of them at most


def room_of_table(buffer: Any) -> int:
    """The room that a table's buffer takes of :data:`TABLES`: its bytes, but one may take all."""
    return min(max(buffer.size, TABLES // 64), TABLES)


@dataclass
class OnTheWay:
    """What goes through a device together, on its way.

    Attributes:
        events: of launches and transfers, by their names.
        tiles_left: that have not landed.
        error: the first one of a tile that has.
    """

    events: list[tuple[str, Any]] = field(default_factory=list, init=False)
    tiles_left: int = field(default=0, init=False)
    error: Exception | None = field(default=None, init=False)


@dataclass
class DeviceImage(OnTheWay):
    """One image on its way: one try to do a task.

    Args:
        task: what is done.
        calls: the compiled kernels of the plan.
        borders: those that fill the borders of what a launch has written, for small images.
        tiling: the tiles.
    """

    task: ImageTask
    calls: Sequence[Call]
    borders: Callable[[Launch], Iterable[Call]]
    tiling: Tiling

    @property
    def is_whole(self) -> bool:
        """Whether the image goes through in one piece."""
        return len(self.tiling.tiles) == 1 and not self.tiling.patches


@dataclass(frozen=True)
class DeviceTile:
    """A tile on its way: the events to wait for, and the copies to make then."""

    image: OnTheWay
    events: list[Any]
    copies: list[Callable[[], None]]


class Flow:
    """The queues and buffers of a context, kept from image to image.

    Args:
        context: the ``pyopencl.Context``.
        alignment: of the host's memory, in bytes, if the device works there; else None.
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
        self._tiles: deque[DeviceTile] = deque()  # on the way
        self._reads: list[Any] = []  # events of fetches from buffers that the next tile writes
        self._launch_cache = LaunchCache()

    def new_queue(self) -> Any:
        """A queue whose commands are done in order, and timed."""
        profiling = self._cl.command_queue_properties.PROFILING_ENABLE
        return self._cl.CommandQueue(self.context, properties=profiling)

    def new_buffer(self, size: int) -> Any:
        """A buffer on the device, or in the host's memory if the device works there.

        PoCL allocates its own at the first launch, and crashes if there is no memory then.
        """
        flags = self._cl.mem_flags
        if not self._in_place:
            return self._cl.Buffer(self.context, flags.READ_WRITE, size)
        room = aligned_empty((size,), np.uint8)
        return self._cl.Buffer(self.context, flags.READ_WRITE | flags.USE_HOST_PTR, hostbuf=room)

    @property
    def depth(self) -> int:
        """The number of tiles that may be on the way at a time."""
        return self.transfers.depth

    def start(self, image: DeviceImage, memory: int) -> None:
        """Enqueue all of an image, while buffers take no more than ``memory`` bytes.

        Where more than :attr:`depth` tiles would be on the way, the oldest ones land. Of an
        incremental plan, launches are left out whose results are on the device.
        """
        known, after = self.forget(), LaunchCache()
        tiling, task = image.tiling, image.task
        self.make_room(tiling.sizes, memory)
        if task.plan.incremental and image.is_whole:
            numbers, after = known.next(
                image.calls,
                self.pool,
                task.source,
                task.options.unchanged,
                tiling.tiles[0],
                task.bind,
            )
            tiling = replace(tiling, phases=(Phase((), numbers, ()),))
        for phase in tiling.phases:
            tiles = tiling.tiles_of(phase)
            self._launch(image, phase.first, tiles[0], 0, {}, [])
            for tile, extents in enumerate(tiles):
                self.make_way()
                is_last = phase is tiling.phases[-1]
                fetches = task.options.download and is_last
                self._pass(image, phase.each, extents, tile, fetches)
            self._launch(image, phase.last, tiles[0], 0, {}, [])
        self._launch_cache = after

    def forget(self) -> LaunchCache:
        """What was known of the buffers' contents, of which nothing is known from now on."""
        known, self._launch_cache = self._launch_cache, LaunchCache()
        return known

    def make_room(self, sizes: Mapping[str, int], memory: int) -> None:
        """Have buffers of these sizes, in bytes by name, while all take at most ``memory``."""
        needs = self.transfers.needs(sizes)
        if not self.pool.has(needs, memory):
            self.drain()  # a buffer's memory on the host goes with it, whatever writes there
        self.pool.reserve(needs, memory)

    def make_way(self) -> None:
        """Let the oldest tiles land, until one more may be on the way."""
        while len(self._tiles) >= self.depth:
            self._land()

    def after_reads(self) -> list[Any]:
        """The events of fetches from buffers that the next tile writes, which it waits for."""
        reads, self._reads = self._reads, []
        return reads

    def fetch(self, sent: DeviceTile, name: str, buffer: Any, size: int, after: list[Any]) -> Array:
        """Fetch the bytes of a buffer, when launches are done; they are there when it lands."""
        array, event = self.transfers.fetch(name, buffer, size, after)
        sent.image.events.append(("download", event))
        sent.events.append(event)
        if name != "dst":
            self._reads.append(event)
        return array

    def fetch_results(
        self,
        sent: DeviceTile,
        members: Sequence[Member],
        strides: Mapping[str, int],
        ends: Mapping[str, Any],
        after: list[Any],
        estimates: bool = True,
    ) -> None:
        """Fetch the results of members of one plan, when launches are done.

        Args:
            sent: gets the copies that are to be made when it lands.
            members: the members.
            strides: bytes from a member to the next in each buffer; one has none.
            ends: the buffers that are no pool's, "dst" of them.
            after: the events of the launches.
            estimates: whether what was estimated from the image is fetched, too.
        """
        plan, output = members[0].task.plan, members[0].task.output
        buffers = {**self.pool.buffers, **ends}

        def parts(name: str, sizes: Sequence[int]) -> list[Array]:
            stride = strides.get(name, 0)
            size = stride * (len(members) - 1) + sizes[-1]
            whole = self.fetch(sent, name, buffers[name], size, after)
            return [whole[n * stride : n * stride + own] for n, own in enumerate(sizes)]

        last = [member.extents[-1] for member in members]
        if plan.encoded and not last[0].core.is_empty:
            samples = len(plan.encoded.channels)
            sizes = [each.stored.width * each.stored.height * samples for each in last]
            for member, extent, pixels in zip(members, last, parts("dst", sizes), strict=True):
                encoded = member.task.output.encoded
                assert encoded is not None
                room = member.room(encoded, extent)
                sent.copies.append(partial(copy_encoded, extent, pixels, room))
        for number in output.images:
            own = [member.extents[plan.level_of(number)] for member in members]
            if own[0].core.is_empty:
                continue
            sizes = [extent.plane_bytes for extent in own]
            for channel, slot in enumerate(plan.slots[number]):
                found = parts(slot_buffer(slot), sizes)
                for member, extent, plane in zip(members, own, found, strict=True):
                    room = member.room(member.task.output.images[number], extent)
                    copy = partial(copy_plane, extent, plane.view(np.float32), room, channel)
                    sent.copies.append(copy)
        for step, values in output.estimates.items() if estimates else ():
            found = parts(step_buffer("estimates", step), [values.nbytes] * len(members))
            for member, part in zip(members, found, strict=True):
                to = member.task.output.estimates[step]
                sent.copies.append(partial(np.copyto, to, part.view(to.dtype)))

    def push(self, tile: DeviceTile) -> None:
        """Have a tile that was enqueued go its way."""
        tile.image.tiles_left += 1
        self._tiles.append(tile)
        self.transfers.flush()

    def finish(self, image: OnTheWay) -> None:
        """Wait until all tiles of an image have landed, and any that were started before it.

        Raises:
            pyopencl.Error: one has failed.
        """
        while image.tiles_left:
            self._land()
        if image.error:
            raise image.error

    def drain(self) -> None:
        """Wait until nothing is on the way."""
        while self._tiles:
            self._land()

    def abandon(self) -> None:
        """After a failure: wait for all that is on the way, and give all memory back."""
        self._tiles.clear()
        self._reads.clear()
        for release in (
            self.queue.finish,
            self.transfers.release,
            self._tables.clear,
            self.pool.release,
        ):
            with suppress(self._cl.Error):
                release()

    def _pass(
        self, image: DeviceImage, numbers: Sequence[int], extents: Extents, tile: int, fetches: bool
    ) -> None:
        """Send a tile if a kernel reads it, launch kernels, and fetch what they made of it."""
        plan = image.task.plan
        own = Member(extents, image.task, tile if image.tiling.patches else None)
        reads_source = any(image.calls[number].reads_source for number in numbers)
        sent = self._send(image, own) if reads_source else (None, [])
        whole = image.task.output.encoded if fetches and image.is_whole else None
        size = extents[-1].stored.width * extents[-1].stored.height
        size *= len(plan.encoded.channels) if plan.encoded else 0
        ends = {"src": sent[0], "dst": self.transfers.target(size, whole)}
        wait = [*sent[1], *self.after_reads()]
        self._launch(image, numbers, extents, tile, ends, wait)
        last = [event for _, event in image.events[-1:]]
        sent_tile = DeviceTile(image, [*wait, *last], [])
        if fetches:
            is_last = tile == len(image.tiling.patches or image.tiling.tiles) - 1
            self.fetch_results(sent_tile, [own], {}, ends, last, is_last)
        self.push(sent_tile)

    @CpuTimer("upload")
    def _send(self, image: DeviceImage, own: Member) -> tuple[Any, list[Any]]:
        """Send what a tile stores of the source, unless it is there already."""
        task, source = image.task, image.task.source
        if (
            image.is_whole
            and (task.options.unchanged or not task.options.download)
            and (sent := self.transfers.again(source))
        ):
            return sent
        size = source_bytes(task.plan, own.extents[0])
        sent = self.transfers.upload(source, own.pixels, own.dtype, size)
        image.events += [("upload", event) for event in sent[1]]
        return sent

    def _launch(
        self,
        image: DeviceImage,
        numbers: Sequence[int],
        extents: Extents,
        tile: int,
        ends: dict[str, Any],
        wait: list[Any],
    ) -> None:
        """Launch kernels of a plan on a tile, the first of them after the events ``wait``."""
        for number in numbers:
            launch = image.calls[number].kernel.launch
            extent = extents[launch.level]
            if extent.is_empty:
                continue
            calls = [image.calls[number]]
            if isinstance(launch, Launch) and (extent.is_small or launch.has_period):
                calls += image.borders(launch)
            events = []
            for call in calls:
                call.set_arguments(self.pool, ends, extents, tile, image.task.bind, self.table)
                sizes = index_space(call.kernel, extent)
                events.append(
                    self._cl.enqueue_nd_range_kernel(
                        self.queue, call.compiled, *sizes, wait_for=wait or None
                    )
                )
                wait = []
            image.events.append((launch.name, events[0]))  # nothing waits for borders

    def _land(self) -> None:
        """Wait for the oldest tile on the way, and copy its results; an error is its image's."""
        tile = self._tiles.popleft()
        tile.image.tiles_left -= 1
        try:
            if tile.events:
                with CpuTimer("kernels"):
                    self._cl.wait_for_events(tile.events)
            with CpuTimer("download"):
                for copy in tile.copies:
                    copy()
            self.transfers.done()
        except self._cl.Error as error:
            tile.image.error = tile.image.error or error

    def table(self, table: Array) -> Any:
        """A constant array on the device, uploaded once while it is the same object."""
        return self._tables.get(Identity(table), lambda: self.new_table(table))

    def new_table(self, table: Array) -> Any:
        """A constant array on the device."""
        flags = self._cl.mem_flags.READ_ONLY | self._cl.mem_flags.COPY_HOST_PTR
        return self._cl.Buffer(self.context, flags, hostbuf=table)
