"""OpenCL devices: which there are, and running a plan on one. The only importer of pyopencl."""

import os
import re
import shutil
import time
import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from clpipe.codegen import (
    LOCAL_SIZE,
    SHARES,
    Kernel,
    Parameter,
    apron_left,
    round_up,
    write_kernel,
)
from clpipe.errors import DeviceError, ImageError, RequestError
from clpipe.memory import available_memory
from clpipe.plan import AddUp, Count, Find, Launch, Lines, Plan
from clpipe.stage import Kind
from clpipe.suggest import one_of
from clpipe.tiles import Extent, Tiling, tiling_of
from clpipe.types import Array

Bind = Callable[[Parameter], Any]
_process: int | None = None  # the one that has used OpenCL, of this and those before it


@dataclass(frozen=True)
class Found:
    """A device that an OpenCL platform offers. ``problem`` says why it cannot be used, if so."""

    index: int
    platform: str
    name: str
    type: str  # "GPU", "CPU", "emulator" or "accelerator"
    version: str  # of OpenCL, as the device tells it
    driver: str
    compute_units: int
    memory: int  # bytes
    max_buffer: int  # bytes
    lanes: int
    problem: str
    handle: Any

    @property
    def label(self) -> str:
        """Name and platform, as people tell devices apart."""
        return f"{self.name.strip()} ({self.platform})"


def find_devices() -> list[Found]:
    """Every device of every OpenCL platform, in the platforms' order.

    Raises:
        DeviceError: pyopencl cannot be loaded, or this process cannot use it.
    """
    global _process
    if _process not in (None, os.getpid()):
        raise DeviceError(
            "this process was forked from one that had used OpenCL, which would hang here; let it "
            'be spawned (multiprocessing\'s "spawn" or "forkserver"), or fork before'
        )
    _process = os.getpid()
    try:
        import pyopencl as cl
    except (ImportError, OSError) as error:
        raise DeviceError(f"pyopencl cannot be loaded: {error}") from None
    try:
        platforms = cl.get_platforms()
    except cl.Error:
        return []
    found: list[Found] = []
    for platform in platforms:
        try:
            devices = platform.get_devices()
        except cl.Error:
            continue
        for device in devices:
            kind = device.type
            type_ = "GPU" if kind & cl.device_type.GPU else "CPU"
            if not kind & (cl.device_type.GPU | cl.device_type.CPU):
                type_ = "accelerator"
            if "oclgrind" in platform.name.lower():
                type_ = "emulator"  # it finds errors in kernels, slowly, and says it is all types
            found.append(
                Found(
                    index=len(found),
                    platform=platform.name.strip(),
                    name=device.name.strip(),
                    type=type_,
                    version=device.version.strip(),
                    driver=device.driver_version.strip(),
                    compute_units=device.max_compute_units,
                    memory=device.global_mem_size,
                    max_buffer=device.max_mem_alloc_size,
                    lanes=lanes_for(type_, platform.name, device),
                    problem=problem_with(type_, platform.name, device),
                    handle=device,
                )
            )
    return found


def lanes_for(type_: str, platform: str, device: Any) -> int:
    """How many lanes the kernels are compiled for: one vector register on a CPU, 1 on a GPU.

    PoCL's compiler takes 8 everywhere: PoCL 3.0 (LLVM 14) crashes on 16 on CPUs that have AVX-512
    but are newer than it (seen on AMD Zen 4), and gains nothing from 16 on the others.
    """
    if type_ != "CPU":
        return 1
    if "Portable Computing" in platform or device.native_vector_width_float < 16:
        return 8
    return 16


def problem_with(type_: str, platform: str, device: Any) -> str:
    """Why a device cannot be used, or nothing."""
    if type_ == "accelerator":
        return "neither a GPU nor a CPU (an emulator or an FPGA)"
    if not device.available or not device.compiler_available:
        return "it is not available or has no compiler"
    if "Portable Computing" in platform and not shutil.which("ld"):
        return (
            "PoCL needs a linker and there is no 'ld' on the PATH "
            "(Debian, Ubuntu: apt-get install binutils; conda: binutils)"
        )
    return ""


def choose(selector: str | None, devices: list[Found]) -> Found:
    """The device to use: the first usable GPU, else the first usable CPU, or what was asked for.

    Args:
        selector: an index from ``clpipe devices``, or a part of a device's or platform's name.

    Raises:
        DeviceError: there is none, none matches, or the one that was asked for cannot be used.
    """
    if not devices:
        raise DeviceError(
            "no OpenCL platform was found; install one (pip install 'pyopencl[pocl]', or your "
            "GPU's driver), or use --device numpy, which is slow but needs none"
        )
    if selector is not None:
        wanted = [
            d
            for d in devices
            if (selector == str(d.index) if selector.isdecimal() else matches(selector, d))
        ]
        if not wanted:
            names = [f"{d.index}: {d.label}" for d in devices]
            raise DeviceError(one_of("device", selector, [*names, "numpy"]))
        usable = [d for d in wanted if not d.problem]
        if not usable:
            raise DeviceError(f"device {wanted[0].label}: {wanted[0].problem}")
        return usable[0]
    usable = [d for kind in ("GPU", "CPU") for d in devices if d.type == kind and not d.problem]
    if not usable:
        reasons = "; ".join(f"{d.label}: {d.problem or 'an emulator'}" for d in devices)
        raise DeviceError(f"no usable OpenCL device ({reasons}); or use --device numpy")
    return usable[0]


def choose_all(selectors: Sequence[str], devices: list[Found]) -> list[Found]:
    """The devices that selectors name, each as :func:`choose` has it, each device once.

    Without selectors these are the one that is chosen by default and, if it is a GPU, all others of
    the same name, which give the same bits.

    Raises:
        DeviceError: as :func:`choose`.
    """
    if not selectors:
        first = choose(None, devices)
        return [first] + [
            d
            for d in devices
            if d.type == first.type == "GPU" and d.name == first.name and not d.problem
            if d.index != first.index
        ]
    chosen = [choose(selector, devices) for selector in selectors]
    return list({d.index: d for d in chosen}.values())


def matches(selector: str, device: Found) -> bool:
    """Whether a selector is a part of a device's name, type or platform ('pocl' counts)."""
    alias = " pocl" if "Portable Computing" in device.platform else ""
    names = f"{device.name} {device.platform} {device.type}{alias}"
    return bool(selector) and selector.lower() in names.lower()


@dataclass(frozen=True)
class Timing:
    """What one launch or transfer took, in seconds on the device.

    ``start`` is on the clock of :func:`time.perf_counter`. Transfers are called "upload" and
    "download".
    """

    name: str
    seconds: float
    start: float
    transfer: bool


@dataclass
class Output:
    """What a run brings back: planes by image number, eight-bit pixels, and numbers found."""

    images: dict[int, Array]
    encoded: Array | None
    found: dict[str, Array]


def build_log(text: str) -> str:
    """What the compiler said, out of pyopencl's error message.

    >>> build_log("failed\\n\\nBuild on <x>:\\n\\nerror: a.cl:2:7: no\\n\\n(options: -a)")
    'error: a.cl:2:7: no'
    """
    log = re.sub(r"\n*\(options: .*", "", text.partition(">:\n")[2], flags=re.DOTALL)
    lines = [line for line in log.splitlines() if "failed to build the program" not in line]
    return "\n".join(lines).strip() or text


def room_for(plan: Plan, width: int, height: int, into: Array | None) -> Output:
    """Whole images on the host for all that a plan gives; ``into`` is for the encoded one."""

    def shape(kind: Kind) -> tuple[int, ...]:
        channels = len(kind.channels)
        return (height, width) if channels == 1 else (height, width, channels)

    images = [image for _, image in plan.kept] + ([plan.final] if plan.final else [])
    encoded = None
    if plan.encoded:
        encoded = np.empty(shape(plan.encoded), np.uint8) if into is None else into
        if encoded.shape != shape(plan.encoded) or encoded.dtype != np.uint8:
            raise ValueError(
                f"into is {encoded.shape} {encoded.dtype}; {shape(plan.encoded)} uint8"
            )
    return Output(
        images={image.number: np.empty(shape(image.kind), np.float32) for image in images},
        encoded=encoded,
        found={x.op.step: np.empty(4, np.float32) for x in plan.launches if isinstance(x, Find)},
    )


def index_space(kernel: Kernel, extent: Extent) -> tuple[tuple[int, ...], tuple[int, ...]]:
    """How many work items a kernel has, and in which groups."""
    match kernel.launch:
        case Launch(rows=rows, columns=columns):
            across = round_up(extent.padded_width, extent.lanes * columns)
            blocks = round_up(across // (extent.lanes * columns), LOCAL_SIZE)
            return (blocks, -(-extent.stored.height // rows)), (LOCAL_SIZE, 1)
        case Lines():
            longest = round_up(max(extent.width, extent.height), extent.lanes)
            return (round_up(longest // extent.lanes, LOCAL_SIZE),), (LOCAL_SIZE,)
        case Count() | AddUp():
            return (SHARES,), (LOCAL_SIZE,)
        case Find():
            return (1,), (1,)


def timed(events: Sequence[tuple[str, Any]]) -> list[Timing]:
    """How long each took. The queue has just been finished, so the last of them ends now."""
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


def usable_memory(chosen: Found) -> int:
    """Bytes that buffers on a device may take by default.

    Of a GPU's, a tenth is left to others. A CPU shares its memory with everybody: half of what is
    available now.
    """
    if chosen.type == "GPU":
        return chosen.memory * 9 // 10
    available = available_memory()
    return min(chosen.memory, available // 2) if available else chosen.memory


class Pool:
    """Device buffers by name, kept from image to image where they are large enough."""

    def __init__(self, make: Callable[[int], Any]) -> None:
        self._make = make
        self.held: dict[str, Any] = {}
        self.generation = 0  # another one when other buffers are held

    def reserve(self, sizes: Mapping[str, int], memory: int) -> None:
        """See that there is a buffer of at least these sizes (bytes by name).

        Those that an earlier image needed stay, as long as all together take no more than
        ``memory`` bytes.
        """
        enough = {name: b for name, b in self.held.items() if b.size >= sizes.get(name, 0)}
        missing = sum(size for name, size in sizes.items() if name not in enough)
        for spare in (lambda name, _: name not in sizes, lambda name, b: b.size > sizes[name]):
            if sum(b.size for b in enough.values()) + missing > memory:
                dropped = [name for name, b in enough.items() if spare(name, b)]
                missing += sum(sizes.get(name, 0) for name in dropped)
                enough = {name: b for name, b in enough.items() if name not in dropped}
        if enough.keys() == self.held.keys() >= sizes.keys():
            return
        self.generation += 1
        for name in self.held.keys() - enough.keys():
            self.held.pop(name).release()
        for name, size in sizes.items():
            if name not in enough:
                self.held[name] = self._make(size)

    @property
    def bytes(self) -> int:
        """What all of them take."""
        return sum(buffer.size for buffer in self.held.values())

    def release(self) -> None:
        """Give all of them back."""
        self.generation += 1
        held, self.held = self.held, {}
        for buffer in held.values():
            buffer.release()


class Call:
    """A compiled kernel and the arguments that it was given last.

    Most arguments stay the same from image to image, and to set one takes time.
    """

    def __init__(self, kernel: Kernel, compiled: Any) -> None:
        self.kernel = kernel
        self.compiled = compiled
        numbered = list(enumerate(kernel.parameters))
        names = [(i, buffer_name(p)) for i, p in numbered]
        self._buffers = [(i, name) for i, name in names if name]
        self._numbers = [(i, p.item) for i, p in numbered if p.role == "tile"]
        self._values = [(i, p) for i, p in numbered if p.role in ("value", "key", "table8")]
        self._last: list[Any] = [None] * len(numbered)
        self._place: tuple[Any, ...] = ()

    def set_arguments(self, pool: "Pool", extent: Extent, tile: int, bind: Bind) -> None:
        """Set what is different from the last time: buffers, a tile's numbers, and values."""
        place = pool.generation, extent, tile
        if place != self._place:
            told = {**extent.numbers, "tile": np.uint32(tile)}
            for i, name in self._buffers:
                self.compiled.set_arg(i, pool.held[name])
            for i, name in self._numbers:
                self.compiled.set_arg(i, told[name])
            self._place = place
        for i, parameter in self._values:
            value, last = bind(parameter), self._last[i]
            if value is not last and not same_bits(value, last):
                self.compiled.set_arg(i, value)
                self._last[i] = value


def same_bits(one: Any, two: Any) -> bool:
    """Whether two NumPy scalars are the same; 0 and -0 are not."""
    scalars = isinstance(one, np.generic) and isinstance(two, np.generic)
    return scalars and one.tobytes() == two.tobytes()


def buffer_name(parameter: Parameter) -> str | None:
    """The buffer of :func:`clpipe.tiles.buffer_sizes` that a parameter stands for, if it does."""
    match parameter.role:
        case "source":
            return "src"
        case "encoded":
            return "dst"
        case "slot":
            return f"slot{parameter.number}"
        case "lines" | "found":
            return f"{parameter.role}.{parameter.step}"
        case "sums" | "shares" | "counts" | "histogram":
            return parameter.role
    return None


class Device:
    """A device with its queue, compiled kernels and buffers, kept from image to image.

    It is for one thread at a time; several devices can run at once, each in its own.

    Args:
        chosen: which device.
        memory: bytes that its buffers may take; None is what it reports. A CPU shares its memory
            with everybody, so it is at most half of what is available now.

    Raises:
        DeviceError: it cannot be opened.
    """

    def __init__(self, chosen: Found, memory: int | None = None) -> None:
        import pyopencl as cl

        self.info = chosen
        self.memory = memory or usable_memory(chosen)
        self._cl = cl
        try:
            self._context = cl.Context([chosen.handle])
            self._queue = cl.CommandQueue(
                self._context, properties=cl.command_queue_properties.PROFILING_ENABLE
            )
        except cl.Error as error:
            raise DeviceError(f"{chosen.label} cannot be opened: {error}") from None
        self._calls: dict[Plan, list[Call]] = {}
        self._programs: dict[str, Any] = {}
        self._pool = Pool(self._new_buffer)
        self._tables: dict[int, tuple[Array, Any]] = {}

    @property
    def bytes_held(self) -> int:
        """Device memory of the buffers that are kept from image to image."""
        return self._pool.bytes

    def prepare(self, plan: Plan) -> list[Call]:
        """The compiled kernels of a plan, from the first call on without compiling.

        Raises:
            DeviceError: a kernel does not compile; the message is the compiler's.
        """
        if plan not in self._calls:
            lanes = self.info.lanes
            kernels = [write_kernel(plan, x, i, lanes) for i, x in enumerate(plan.launches)]
            self._calls[plan] = [Call(k, self._compile(k)) for k in kernels]
        return self._calls[plan]

    def _compile(self, kernel: Kernel) -> Any:
        cl = self._cl
        program = self._programs.get(kernel.source)
        if program is None:
            options = ["-cl-std=CL1.2"]
            exact = cl.device_fp_config.CORRECTLY_ROUNDED_DIVIDE_SQRT
            if self.info.handle.single_fp_config & exact:
                options.append("-cl-fp32-correctly-rounded-divide-sqrt")
            # PoCL keeps a cache of its own; a second copy only costs time.
            own_cache = "Portable Computing" in self.info.platform
            # Not within catch_warnings, which is no matter of one thread.
            warnings.filterwarnings("ignore", category=cl.CompilerWarning)
            try:
                program = cl.Program(self._context, kernel.source).build(
                    options, cache_dir=False if own_cache else None
                )
            except cl.MemoryError:
                raise
            except cl.Error as error:
                log = build_log(str(error))
                for file in kernel.files:
                    if Path(file).is_absolute():
                        raise RequestError(f"{file}: does not compile:\n{log}") from None
                raise DeviceError(f"{kernel.launch.name}: does not compile:\n{log}") from None
            self._programs[kernel.source] = program
        return cl.Kernel(program, kernel.name)

    def run(
        self,
        plan: Plan,
        source: Array,
        bind: Bind,
        timings: list[Timing] | None = None,
        download: bool = True,
        into: Array | None = None,
    ) -> Output:
        """Put one image through a plan; in tiles where it does not fit into the memory.

        Where the memory that is allowed is not there, buffers of earlier images are given back,
        then tiles become smaller.

        Args:
            plan: what to do.
            source: the image, (height, width[, channel]), of a type that becomes half floats or
                floats, as the plan says, without loss.
            bind: the value of a "value", "key" or "table8" parameter: a NumPy scalar or array.
            timings: is given one entry a launch and transfer, in order.
            download: bring results back; False leaves them on the device (for measuring).
            into: where the eight-bit pixels are put, (height, width[, channel]) uint8,
                C-contiguous; memory that is new to the process costs time.

        Raises:
            ImageError: the image does not fit into the device's memory, not even in tiles, or the
                device fails.
            DeviceError: a kernel does not compile.
        """
        cl = self._cl
        height, width = source.shape[:2]
        memory = self.memory
        full: Exception | None = None  # what the device said when there was no more
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
                return self._run(plan, tiling, source, bind, timings, download, into)
            except cl.MemoryError as error:
                self._abandon()
                memory = memory if full is None else tiling.bytes // 2
                full = error
            except cl.Error as error:
                self._abandon()
                raise ImageError(f"{self.info.label} failed: {error}") from None

    def _run(
        self,
        plan: Plan,
        tiling: Tiling,
        source: Array,
        bind: Bind,
        timings: list[Timing] | None,
        download: bool,
        into: Array | None,
    ) -> Output:
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

        def launch(numbers: tuple[int, ...], extent: Extent, tile: int) -> None:
            for number in numbers:
                call = calls[number]
                call.set_arguments(self._pool, extent, tile, value_of)
                sizes = index_space(call.kernel, extent)
                event = self._cl.enqueue_nd_range_kernel(self._queue, call.compiled, *sizes)
                events.append((call.kernel.launch.name, event))

        for phase in tiling.phases:
            launch(phase.first, tiling.tiles[0], 0)
            for tile, extent in enumerate(tiling.tiles):
                if upload:
                    events.append(("upload", self._upload(plan, extent, source)))
                launch(phase.each, extent, tile)
                if download and phase is tiling.phases[-1]:
                    events += [("download", e) for e in self._download(plan, extent, output)]
            launch(phase.last, tiling.tiles[0], 0)
        if download:
            events += [("download", e) for e in self._find(output)]
        self._queue.finish()
        if timings is not None:
            timings += timed(events)
        return output if download else Output({}, None, {})

    def _new_buffer(self, size: int) -> Any:
        return self._cl.Buffer(self._context, self._cl.mem_flags.READ_WRITE, size)

    def _abandon(self) -> None:
        """Wait for what is still to be done of an image that failed, and give all memory back."""
        with suppress(self._cl.Error):
            self._queue.finish()
        with suppress(self._cl.Error):
            self._tables.clear()
            self._pool.release()

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

    def _download(self, plan: Plan, extent: Extent, output: Output) -> Iterator[Any]:
        """Bring the core of a tile into the whole images."""
        core, stored, held = extent.core, extent.stored, self._pool.held
        if output.encoded is not None:
            channels = output.encoded.size // (extent.width * extent.height)
            first = core.left - stored.left, core.top - stored.top
            if core.width == extent.width:
                rows = output.encoded[core.top : core.bottom]
                start = first[1] * core.width * channels
                yield self._cl.enqueue_copy(
                    self._queue, rows, held["dst"], src_offset=start, is_blocking=False
                )
            else:
                yield self._cl.enqueue_copy(
                    self._queue,
                    output.encoded,
                    held["dst"],
                    buffer_origin=(first[0] * channels, first[1], 0),
                    host_origin=(core.left * channels, core.top, 0),
                    region=(core.width * channels, core.height, 1),
                    buffer_pitches=(stored.width * channels,),
                    host_pitches=(extent.width * channels,),
                )
        if not output.images:
            return
        plane = np.empty(extent.plane_bytes // 4, np.float32)
        height = extent.padded_height + 2 * plan.apron
        top = plan.apron + core.top - stored.top
        left = apron_left(plan.apron, extent.lanes) + core.left - stored.left
        for number, image in output.images.items():
            whole = image.reshape(extent.height, extent.width, -1)
            part = whole[core.top : core.bottom, core.left : core.right]
            for channel, slot in enumerate(plan.slots[number]):
                yield self._cl.enqueue_copy(
                    self._queue, plane, held[f"slot{slot}"], is_blocking=True
                )
                rows = plane[: height * extent.pitch].reshape(height, extent.pitch)
                part[..., channel] = rows[top : top + core.height, left : left + core.width]

    def _find(self, output: Output) -> Iterator[Any]:
        """Bring what was found in the image."""
        for step, values in output.found.items():
            yield self._cl.enqueue_copy(self._queue, values, self._pool.held[f"found.{step}"])

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
    """The device that a selector names, as :func:`choose` has it; None for "numpy".

    ``memory`` is how many bytes of it may be used.

    Raises:
        DeviceError: there is none, none matches, or the one that was asked for cannot be used.
    """
    if selector is not None and selector.lower() == "numpy":
        return None
    return Device(choose(selector, find_devices()), memory)


def open_devices(selectors: Sequence[str] = (), memory: int | None = None) -> list[Device]:
    """The devices that selectors name, as :func:`choose_all` has them; none for "numpy".

    ``memory`` is how many bytes may be used of each; without it, CPUs share what there is.

    Raises:
        DeviceError: as :func:`open_device`, or "numpy" stands beside others.
    """
    if any(selector.lower() == "numpy" for selector in selectors):
        if len(selectors) > 1:
            raise DeviceError(f"found devices {', '.join(selectors)}; numpy is used alone")
        return []
    chosen = choose_all(selectors, find_devices())
    sharing = sum(found.type != "GPU" for found in chosen)
    return [
        Device(found, memory or usable_memory(found) // (1 if found.type == "GPU" else sharing))
        for found in chosen
    ]
