"""Images on their way through a device: what is enqueued, and what is still to be fetched.

An image goes through in parts: its tiles, once in each phase. A part is sent, launched and fetched;
it has landed when its results are in the host's arrays. Parts of one image or of neighbours may be
on the way together.
"""

from collections import deque
from collections.abc import Callable, Iterable, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any

import numpy as np

from clpipe.base.cache import BoundedCache, Identity
from clpipe.base.steps import Step
from clpipe.base.types import Array
from clpipe.engine.buffers import HostImages, Pool, aligned_empty, copy_encoded, copy_plane, core_of
from clpipe.engine.calls import Bind, Call, index_space
from clpipe.engine.extents import Box, Extent, Extents
from clpipe.engine.held import Held
from clpipe.engine.plan import Launch, Plan
from clpipe.engine.tiles import Phase, Tiling, source_bytes
from clpipe.engine.transfers import InPlace, Staged

TABLES = 1 << 26  # bytes of arrays that are kept on the device, 64 of them at most


def room_of_table(buffer: Any) -> int:
    """What a table's buffer takes of :data:`TABLES`: its bytes, but one may take all."""
    return min(max(buffer.size, TABLES // 64), TABLES)


@dataclass(frozen=True)
class Work:
    """What is to be done to one image.

    Args:
        plan: the plan.
        source: the image, (height, width[, channel]).
        bind: the value of a "value", "key" or "table8" parameter: a NumPy scalar or array.
        output: where the results go.
        boxes: the patches of the results that are made; () is all of them.
        download: whether they do.
        unchanged: whether the source, if it is the array that was sent last, holds the same pixels.
    """

    plan: Plan
    source: Array
    bind: Bind
    output: HostImages
    boxes: Sequence[Box]
    download: bool
    unchanged: bool


@dataclass
class Passage:
    """One image on its way: one try to do some work.

    Args:
        work: what is done.
        calls: the compiled kernels of the plan.
        borders: those that fill the borders of what a launch has written, for small images.
        tiling: the tiles.
    """

    work: Work
    calls: Sequence[Call]
    borders: Callable[[Launch], Iterable[Call]]
    tiling: Tiling
    events: list[tuple[str, Any]] = field(default_factory=list)  # of launches and transfers
    parts: int = 0  # that have not landed
    error: Exception | None = None  # the first one of a part that has

    @property
    def is_whole(self) -> bool:
        """Whether the image goes through in one piece."""
        return len(self.tiling.tiles) == 1 and not self.tiling.patches


@dataclass(frozen=True)
class Part:
    """A tile on its way: the events to wait for, and the copies to make then."""

    passage: Passage
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
        self._transfers: InPlace | Staged = (
            InPlace(cl, self.queue, alignment)
            if alignment
            else Staged(cl, self.queue, self.new_queue, self.pool)
        )
        self._tables: BoundedCache[Any] = BoundedCache(TABLES, room_of_table)
        self._parts: deque[Part] = deque()  # on the way
        self._reads: list[Any] = []  # events of fetches from buffers that the next part writes
        self._held = Held()

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
        """How many parts may be on the way at a time."""
        return self._transfers.depth

    def start(self, passage: Passage, memory: int) -> None:
        """Enqueue all of an image, while buffers take no more than ``memory`` bytes.

        Where more than :attr:`depth` parts would be on the way, the oldest ones land. Of a plan
        that holds its images, launches are left out whose results are on the device.
        """
        # Nothing is known of what buffers hold until all is enqueued.
        known, self._held, after = self._held, Held(), Held()
        tiling, work = passage.tiling, passage.work
        self.pool.reserve(self._transfers.needs(tiling.sizes), memory)
        if work.plan.hold and passage.is_whole:
            options = work.source, work.unchanged, tiling.tiles[0], work.bind
            numbers, after = known.next(passage.calls, self.pool, *options)
            tiling = replace(tiling, phases=(Phase((), numbers, ()),))
        for phase in tiling.phases:
            tiles = tiling.tiles_of(phase)
            self._launch(passage, phase.first, tiles[0], 0, {}, [])
            for tile, extents in enumerate(tiles):
                while len(self._parts) >= self.depth:
                    self._land()
                is_last = phase is tiling.phases[-1]
                self._pass(passage, phase.each, extents, tile, work.download and is_last)
            self._launch(passage, phase.last, tiles[0], 0, {}, [])
        self._held = after

    def finish(self, passage: Passage) -> None:
        """Wait until all parts of an image have landed, and any that were started before it.

        Raises:
            pyopencl.Error: one has failed.
        """
        while passage.parts:
            self._land()
        if passage.error:
            raise passage.error

    def drain(self) -> None:
        """Wait until nothing is on the way."""
        while self._parts:
            self._land()

    def abandon(self) -> None:
        """After a failure: wait for all that is on the way, and give all memory back."""
        self._parts.clear()
        self._reads.clear()
        for release in (
            self.queue.finish,
            self._transfers.release,
            self._tables.clear,
            self.pool.release,
        ):
            with suppress(self._cl.Error):
                release()

    def _pass(
        self, passage: Passage, numbers: Sequence[int], extents: Extents, tile: int, fetches: bool
    ) -> None:
        """Send a tile if a kernel reads it, launch kernels, and fetch what they made of it."""
        plan = passage.work.plan
        reads_source = any(passage.calls[number].reads_source for number in numbers)
        sent = self._send(passage, extents) if reads_source else (None, [])
        whole = passage.work.output.encoded if fetches and passage.is_whole else None
        size = extents[-1].stored.width * extents[-1].stored.height
        size *= len(plan.encoded.channels) if plan.encoded else 0
        ends = {"src": sent[0], "dst": self._transfers.target(size, whole)}
        wait, self._reads = [*sent[1], *self._reads], []
        self._launch(passage, numbers, extents, tile, ends, wait)
        last = [event for _, event in passage.events[-1:]]
        part = Part(passage, [*wait, *last], [])
        if fetches:
            self._fetch(part, extents, tile, ends, size, last)
        passage.parts += 1
        self._parts.append(part)
        self._transfers.flush()

    @Step("upload")
    def _send(self, passage: Passage, extents: Extents) -> tuple[Any, list[Any]]:
        """Send what a tile stores of the source, unless it is there already."""
        work, source, box = passage.work, passage.work.source, extents[0].stored
        if (
            passage.is_whole
            and (work.unchanged or not work.download)
            and (sent := self._transfers.again(source))
        ):
            return sent
        pixels = source[box.top : box.bottom, box.left : box.right]
        if work.plan.planar:
            pixels = pixels.transpose(2, 0, 1)
        dtype = np.float16 if work.plan.half else np.float32
        size = source_bytes(work.plan, extents[0])
        sent = self._transfers.upload(source, pixels, dtype, size)
        passage.events += [("upload", event) for event in sent[1]]
        return sent

    def _launch(
        self,
        passage: Passage,
        numbers: Sequence[int],
        extents: Extents,
        tile: int,
        ends: dict[str, Any],
        wait: list[Any],
    ) -> None:
        """Launch kernels of a plan on a tile, the first of them after the events ``wait``."""
        for number in numbers:
            launch = passage.calls[number].kernel.launch
            extent = extents[launch.level]
            if extent.is_empty:
                continue
            calls = [passage.calls[number]]
            if isinstance(launch, Launch) and extent.is_small:
                calls += passage.borders(launch)
            events = []
            for call in calls:
                call.set_arguments(self.pool, ends, extents, tile, passage.work.bind, self._table)
                sizes = index_space(call.kernel, extent)
                events.append(
                    self._cl.enqueue_nd_range_kernel(
                        self.queue, call.compiled, *sizes, wait_for=wait or None
                    )
                )
                wait = []
            passage.events.append((launch.name, events[0]))  # nothing waits for borders

    def _fetch(
        self,
        part: Part,
        extents: Extents,
        tile: int,
        ends: dict[str, Any],
        size: int,
        after: list[Any],
    ) -> None:
        """Fetch a tile's results, and with the last tile what was estimated from the image."""
        passage, transfers, held = part.passage, self._transfers, self.pool.held
        plan, output = passage.work.plan, passage.work.output
        patches = passage.tiling.patches

        def fetch(name: str, buffer: Any, size: int) -> Array:
            array, event = transfers.fetch(name, buffer, size, after)
            passage.events.append(("download", event))
            part.events.append(event)
            if name != "dst":
                self._reads.append(event)
            return array

        def room(image: Array, extent: Extent) -> Array:
            return image[tile] if patches else core_of(extent, image)

        if output.encoded is not None and not extents[-1].core.is_empty:
            pixels = fetch("dst", ends["dst"], size)
            encoded = room(output.encoded, extents[-1])
            part.copies.append(partial(copy_encoded, extents[-1], pixels, encoded))
        for number, image in output.images.items():
            extent = extents[plan.level_of(number)]
            if extent.core.is_empty:
                continue
            for channel, slot in enumerate(plan.slots[number]):
                name = f"slot{slot}"
                plane = fetch(name, held[name], extent.plane_bytes).view(np.float32)
                to = room(image, extent)
                part.copies.append(partial(copy_plane, extent, plane, to, channel))
        if tile == len(patches or passage.tiling.tiles) - 1:
            for step, values in output.estimates.items():
                name = f"estimates.{step}"
                found = fetch(name, held[name], values.nbytes).view(values.dtype)
                part.copies.append(partial(np.copyto, values, found))

    def _land(self) -> None:
        """Wait for the oldest part on the way, and copy its results; an error is its image's."""
        part = self._parts.popleft()
        part.passage.parts -= 1
        try:
            if part.events:
                with Step("kernels"):
                    self._cl.wait_for_events(part.events)
            with Step("download"):
                for copy in part.copies:
                    copy()
            self._transfers.done()
        except self._cl.Error as error:
            part.passage.error = part.passage.error or error

    def _table(self, table: Array) -> Any:
        """A constant array on the device, uploaded once while it is the same object."""
        flags = self._cl.mem_flags.READ_ONLY | self._cl.mem_flags.COPY_HOST_PTR
        upload = partial(self._cl.Buffer, self.context, flags, hostbuf=table)
        return self._tables.get(Identity(table), upload)
