"""An open OpenCL device: it puts images through plans, whole or in tiles."""

import logging
import time
from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass
from typing import Any

import numpy as np

from clpipe.base.errors import DeviceError, DeviceFailedError, ImageError
from clpipe.base.types import Array
from clpipe.engine.buffers import HostImages, Pool, room_for
from clpipe.engine.calls import Bind, Call, index_space
from clpipe.engine.codegen import border_left, write_kernel
from clpipe.engine.discovery import (
    DeviceInfo,
    choose,
    choose_all,
    find_devices,
    shared_out,
    usable_memory,
)
from clpipe.engine.plan import Border, Launch, Plan
from clpipe.engine.programs import forget_programs, programs_of
from clpipe.engine.tiles import Extent, Extents, Tiling, tiling_of
from clpipe.engine.writer import Parameter

log = logging.getLogger(__name__)
FAILURES = 3  # images in a row that a device fails at, before it is given up


@dataclass(frozen=True)
class Timing:
    """How long one launch or transfer took, in seconds on the device.

    ``start`` is on the clock of :func:`time.perf_counter`. Transfers are called "upload" and
    "download".
    """

    name: str
    seconds: float
    start: float
    transfer: bool


def timed(events: Sequence[tuple[str, Any]]) -> list[Timing]:
    """The timings of events. The queue has just been finished, so the last one ends now."""
    if not events:
        return []
    offset = time.perf_counter() - events[-1][1].profile.end * 1e-9
    transfers = ("upload", "download")
    return [
        Timing(
            name,
            (event.profile.end - event.profile.start) * 1e-9,
            event.profile.start * 1e-9 + offset,
            name in transfers,
        )
        for name, event in events
    ]


class Device:
    """An open device with its queue, compiled kernels and buffers, kept from image to image.

    One thread may use it at a time; several devices can run at once, each in a thread of its own.

    Args:
        chosen: which device.
        memory: bytes that its buffers may take; None is what it reports. A CPU shares its memory
            with everybody, so it is at most half of what is available now.

    Raises:
        DeviceError: it cannot be opened.
    """

    def __init__(self, chosen: DeviceInfo, memory: int | None = None) -> None:
        import pyopencl as cl

        self.info = chosen
        self.memory = memory or usable_memory(chosen)
        self._cl = cl
        self._failures = 0  # images in a row
        self._open()

    def _open(self) -> None:
        """Make a queue, and nothing else yet, in the context that all on this device share.

        Raises:
            DeviceError: the device cannot be opened.
        """
        self._programs = programs_of(self.info)
        self._context = self._programs.context
        self._calls: dict[Plan, list[Call]] = {}
        self._border_calls: dict[Border, Call] = {}
        self._pool = Pool(self._new_buffer)
        self._tables: dict[int, tuple[Array, Any]] = {}
        try:
            self._queue = self._new_queue()
        except self._cl.Error as error:
            raise DeviceError(f"{self.info.label} cannot be opened: {error}") from None

    def _new_queue(self) -> Any:
        profiling = self._cl.command_queue_properties.PROFILING_ENABLE
        return self._cl.CommandQueue(self._context, properties=profiling)

    @property
    def bytes_held(self) -> int:
        """Device memory of the buffers that are kept from image to image."""
        return self._pool.bytes

    def is_ready(self, plan: Plan) -> bool:
        """Whether the kernels of a plan are compiled."""
        return plan.unscaled in self._calls

    def prepare(self, plan: Plan) -> list[Call]:
        """The compiled kernels of a plan, from the first call on without compiling.

        Raises:
            DeviceError: a kernel does not compile; the message is the compiler's.
        """
        if plan.unscaled not in self._calls:
            kernels = [write_kernel(plan, launch, self.info.lanes) for launch in plan.launches]
            self._calls[plan.unscaled] = [Call(k, self._programs.kernel(k)) for k in kernels]
        return self._calls[plan.unscaled]

    def _borders(self, plan: Plan, written: Launch) -> Iterator[Call]:
        """The calls that fill the borders of the planes that a launch has written."""
        slots = plan.slots[written.writes.number] if written.writes else ()
        for slot in slots:
            border = Border(slot, written.level)
            if border not in self._border_calls:
                kernel = write_kernel(plan, border, self.info.lanes)
                self._border_calls[border] = Call(kernel, self._programs.kernel(kernel))
            yield self._border_calls[border]

    def run(
        self,
        plan: Plan,
        source: Array,
        bind: Bind,
        timings: list[Timing] | None = None,
        download: bool = True,
        into: Array | None = None,
    ) -> HostImages:
        """Put one image through a plan, in tiles if it does not fit into the memory.

        If the device runs out of memory before the limit is reached, buffers of earlier images are
        given back, then tiles become smaller. If a kernel fails, the image is tried once more; if
        its context is of no more use then, everything is made anew before.

        Args:
            plan: the plan.
            source: the image, (height, width[, channel]), of a type that converts without loss to
                what the plan reads, half or float.
            bind: the value of a "value", "key" or "table8" parameter: a NumPy scalar or array.
            timings: one entry a launch and transfer is appended, in order.
            download: bring results back; False leaves them on the device, for measuring.
            into: an array to use for the eight-bit pixels, (height, width[, channel]) uint8,
                C-contiguous; a used one saves the time that new memory takes.

        Raises:
            ImageError: the image does not fit into the device's memory, not even in tiles.
            DeviceFailedError: the device fails, also when it is tried again.
            DeviceError: a kernel does not compile, or the device has failed at :data:`FAILURES`
                images in a row.
        """
        cl = self._cl
        height, width = source.shape[:2]
        memory = self.memory
        full: Exception | None = None  # the device's error when its memory ran out
        failed = False
        while True:
            try:
                tiling = tiling_of(
                    plan, width, height, self.info.lanes, memory, min(memory, self.info.max_buffer)
                )
            except ImageError:
                if full is None:
                    raise
                raise ImageError(
                    f"{width}x{height} pixels: {self.info.label} is out of memory, in tiles of any "
                    f"size; others may be using it ({full})"
                ) from None
            try:
                output = self._run(plan, tiling, source, bind, timings, download, into)
            except cl.Error as error:
                self._abandon()
                if not self._works():
                    self._renew()
                elif isinstance(error, cl.MemoryError):
                    memory = memory if full is None else tiling.bytes // 2
                    full = error
                    continue
                if not failed:
                    failed = True
                    continue
                self._count_failure(error)
                raise DeviceFailedError(f"{self.info.label} failed: {error}") from None
            self._failures = 0
            return output

    def _run(
        self,
        plan: Plan,
        tiling: Tiling,
        source: Array,
        bind: Bind,
        timings: list[Timing] | None,
        download: bool,
        into: Array | None,
    ) -> HostImages:
        calls = self.prepare(plan)
        if len(self._tables) > 32:
            self._tables.clear()
        upload = download or len(tiling.tiles) > 1 or "src" not in self._pool.held
        self._pool.reserve(tiling.sizes, self.memory)
        output = room_for(plan, source.shape[1], source.shape[0], into)
        events: list[tuple[str, Any]] = []

        def value_of(parameter: Parameter) -> Any:
            value = bind(parameter)
            return self._table(value) if isinstance(value, np.ndarray) else value

        def enqueue(call: Call, extents: Extents, tile: int) -> Any:
            call.set_arguments(self._pool, extents, tile, value_of)
            sizes = index_space(call.kernel, extents[call.kernel.launch.level])
            return self._cl.enqueue_nd_range_kernel(self._queue, call.compiled, *sizes)

        def launch(numbers: tuple[int, ...], extents: Extents, tile: int) -> None:
            for number in numbers:
                done = calls[number].kernel.launch
                if extents[done.level].is_empty:
                    continue
                events.append((done.name, enqueue(calls[number], extents, tile)))
                if isinstance(done, Launch) and extents[done.level].is_small:
                    for border in self._borders(plan, done):
                        enqueue(border, extents, tile)

        for phase in tiling.phases:
            launch(phase.first, tiling.tiles[0], 0)
            for tile, extents in enumerate(tiling.tiles):
                if upload:
                    events.append(("upload", self._upload(plan, extents[0], source)))
                launch(phase.each, extents, tile)
                if download and phase is tiling.phases[-1]:
                    events += [("download", e) for e in self._download(plan, extents, output)]
            launch(phase.last, tiling.tiles[0], 0)
        if download:
            events += [("download", e) for e in self._download_estimates(output)]
        self._queue.finish()
        if timings is not None:
            timings += timed(events)
        return output if download else HostImages({}, None, {})

    def _new_buffer(self, size: int) -> Any:
        return self._cl.Buffer(self._context, self._cl.mem_flags.READ_WRITE, size)

    def _abandon(self) -> None:
        """After a failure: wait for the rest of that image, and give all memory back."""
        with suppress(self._cl.Error):
            self._queue.finish()
        with suppress(self._cl.Error):
            self._tables.clear()
            self._pool.release()

    def _works(self) -> bool:
        """Whether the context still does what it is told, after an error.

        Codes do not say: NVIDIA reports a kernel that reads astray as CL_OUT_OF_RESOURCES, which is
        also a lack of memory. But after it everything in that context fails.
        """
        cl, sent, back = self._cl, np.arange(4, dtype=np.uint8), np.zeros(4, np.uint8)
        try:
            queue = self._new_queue()
            flags = cl.mem_flags.READ_WRITE | cl.mem_flags.COPY_HOST_PTR
            cl.enqueue_copy(queue, back, cl.Buffer(self._context, flags, hostbuf=sent))
            queue.finish()
        except cl.Error:
            return False
        return np.array_equal(sent, back)

    def _renew(self) -> None:
        """Leave a context that is of no more use, with all that is in it, for a new one.

        Raises:
            DeviceError: the device cannot be opened again.
        """
        log.warning("%s failed, and is opened again", self.info.label)
        forget_programs(self.info, self._programs)
        self._open()

    def _count_failure(self, error: Exception) -> None:
        """Count an image that the device failed at, though it was tried again.

        Raises:
            DeviceError: there were too many in a row.
        """
        self._failures += 1
        if self._failures >= FAILURES:
            raise DeviceError(
                f"{self.info.label} failed at {self._failures} images in a row and is given up: "
                f"{error}"
            ) from None

    def _table(self, table: Array) -> Any:
        """A small constant array on the device, uploaded once."""
        cl = self._cl
        if id(table) not in self._tables:
            flags = cl.mem_flags.READ_ONLY | cl.mem_flags.COPY_HOST_PTR
            # The array is held so that its id stays its own.
            self._tables[id(table)] = table, cl.Buffer(self._context, flags, hostbuf=table)
        return self._tables[id(table)][1]

    def _upload(self, plan: Plan, extent: Extent, image: Array) -> Any:
        box = extent.stored
        dtype = np.float16 if plan.half else np.float32
        part = np.ascontiguousarray(image[box.top : box.bottom, box.left : box.right], dtype)
        event = self._cl.enqueue_copy(self._queue, self._pool.held["src"], part, is_blocking=False)
        if part.flags.owndata:
            event.wait()  # or the event would hold the copy until the image is done
        return event

    def _download(self, plan: Plan, extents: Extents, output: HostImages) -> Iterator[Any]:
        """Copy the core of a tile into the whole images."""
        if output.encoded is not None and not extents[-1].core.is_empty:
            yield self._download_encoded(extents[-1], output.encoded)
        for number, image in output.images.items():
            extent = extents[plan.level_of(number)]
            core, stored = extent.core, extent.stored
            if core.is_empty:
                continue
            plane = np.empty(extent.plane_bytes // 4, np.float32)
            height = extent.padded_height + 2 * plan.border
            top = plan.border + core.top - stored.top
            left = border_left(plan.border, extent.lanes) + core.left - stored.left
            whole = image.reshape(extent.height, extent.width, -1)
            part = whole[core.top : core.bottom, core.left : core.right]
            for channel, slot in enumerate(plan.slots[number]):
                yield self._cl.enqueue_copy(
                    self._queue, plane, self._pool.held[f"slot{slot}"], is_blocking=True
                )
                rows = plane[: height * extent.pitch].reshape(height, extent.pitch)
                part[..., channel] = rows[top : top + core.height, left : left + core.width]

    def _download_encoded(self, extent: Extent, whole: Array) -> Any:
        """Copy the core of a tile into the whole eight-bit image."""
        core, stored, encoded = extent.core, extent.stored, self._pool.held["dst"]
        channels = whole.size // (extent.width * extent.height)
        left, top = core.left - stored.left, core.top - stored.top
        if core.width == extent.width:
            rows = whole[core.top : core.bottom]
            start = top * core.width * channels
            return self._cl.enqueue_copy(
                self._queue, rows, encoded, src_offset=start, is_blocking=False
            )
        return self._cl.enqueue_copy(
            self._queue,
            whole,
            encoded,
            buffer_origin=(left * channels, top, 0),
            host_origin=(core.left * channels, core.top, 0),
            region=(core.width * channels, core.height, 1),
            buffer_pitches=(stored.width * channels,),
            host_pitches=(extent.width * channels,),
        )

    def _download_estimates(self, output: HostImages) -> Iterator[Any]:
        """Copy the numbers that stages estimated from the image."""
        for step, values in output.estimates.items():
            yield self._cl.enqueue_copy(self._queue, values, self._pool.held[f"estimates.{step}"])

    def copy_speed(self, size: int = 96 * 2**20) -> float:
        """Bytes a second, read plus written, of the device's own buffer copy; the best of five."""
        cl = self._cl
        one, two = (cl.Buffer(self._context, cl.mem_flags.READ_WRITE, size) for _ in range(2))
        best = 0.0
        for _ in range(6):
            start = time.perf_counter()
            cl.enqueue_copy(self._queue, two, one, byte_count=size).wait()
            best = max(best, 2 * size / (time.perf_counter() - start))
        one.release()
        two.release()
        return best


def open_device(selector: str | None, memory: int | None = None) -> Device | None:
    """Open the device that a selector names, see :func:`choose`; None stands for "numpy".

    ``memory`` is how many bytes its buffers may take.

    Raises:
        DeviceError: there is no device, none matches, or the one that matches cannot be used.
    """
    if selector is not None and selector.lower() == "numpy":
        return None
    return Device(choose(selector, find_devices()), memory)


def open_devices(
    selectors: Sequence[str] = (), memory: int | None = None, share: tuple[int, int] = (0, 1)
) -> list[Device]:
    """Open the devices that selectors name, see :func:`choose_all`; an empty list for "numpy".

    Args:
        selectors: of the devices.
        memory: bytes that the buffers of each may take; without it, CPUs share what is free, and
            processes share a GPU's.
        share: the number of this process and of how many, where several of this machine share the
            devices, see :func:`~clpipe.engine.discovery.shared_out`.

    Raises:
        DeviceError: as :func:`open_device`, or "numpy" stands beside others.
    """
    if any(selector.lower() == "numpy" for selector in selectors):
        if len(selectors) > 1:
            raise DeviceError(f"found devices {', '.join(selectors)}; numpy is used alone")
        return []
    chosen = choose_all(selectors, find_devices())
    processes = share[1]
    on_each_gpu = -(-processes // len(chosen))
    on_cpus = max(sum(info.type != "GPU" for info in chosen), processes)
    return [
        Device(
            info, memory or usable_memory(info) // (on_each_gpu if info.type == "GPU" else on_cpus)
        )
        for info in shared_out(chosen, *share)
    ]
