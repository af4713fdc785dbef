"""OpenCL devices: which there are, and running a plan on one. The only importer of pyopencl."""

import os
import re
import shutil
import time
import warnings
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
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
from clpipe.plan import AddUp, Count, Find, Image, Launch, Lines, Plan
from clpipe.suggest import one_of
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


def matches(selector: str, device: Found) -> bool:
    """Whether a selector is a part of a device's name, type or platform ('pocl' counts)."""
    alias = " pocl" if "Portable Computing" in device.platform else ""
    names = f"{device.name} {device.platform} {device.type}{alias}"
    return bool(selector) and selector.lower() in names.lower()


@dataclass(frozen=True)
class Extent:
    """The size of an image and of its planes on a device."""

    width: int
    height: int
    lanes: int
    apron: int

    @cached_property
    def pitch(self) -> int:
        """Floats from one row of a plane to the next."""
        pitch = self.columns + 2 * apron_left(self.apron, self.lanes)
        # Rows a multiple of 4 KiB apart would fall into the same cache sets.
        return pitch + self.lanes * (pitch % 1024 == 0)

    @property
    def columns(self) -> int:
        """The width, in whole blocks."""
        return round_up(self.width, self.lanes)

    @property
    def rows(self) -> int:
        """The height, in whole blocks of four."""
        return round_up(self.height, 4)

    @property
    def plane_bytes(self) -> int:
        """The size of a plane with its apron; the last block's loads may run over by its width."""
        return ((self.rows + 2 * self.apron) * self.pitch + 5 * self.lanes) * 4


@dataclass(frozen=True)
class Timing:
    """What one launch took, in seconds on the device."""

    name: str
    seconds: float


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


class Device:
    """A device with its queue, compiled kernels and buffers, kept from image to image."""

    def __init__(self, chosen: Found) -> None:
        import pyopencl as cl

        self.info = chosen
        self._cl = cl
        self._context = cl.Context([chosen.handle])
        self._queue = cl.CommandQueue(
            self._context, properties=cl.command_queue_properties.PROFILING_ENABLE
        )
        self._kernels: dict[Plan, list[tuple[Kernel, Any]]] = {}
        self._programs: dict[str, Any] = {}
        self._buffers: dict[str, Any] = {}
        self._tables: dict[int, tuple[Array, Any]] = {}

    def prepare(self, plan: Plan) -> list[tuple[Kernel, Any]]:
        """The compiled kernels of a plan, from the first call on without compiling.

        Raises:
            DeviceError: a kernel does not compile; the message is the compiler's.
        """
        if plan not in self._kernels:
            lanes = self.info.lanes
            kernels = [write_kernel(plan, x, i, lanes) for i, x in enumerate(plan.launches)]
            self._kernels[plan] = [(k, self._compile(k)) for k in kernels]
        return self._kernels[plan]

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
            try:
                with warnings.catch_warnings():
                    warnings.simplefilter("ignore")
                    program = cl.Program(self._context, kernel.source).build(
                        options, cache_dir=False if own_cache else None
                    )
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
    ) -> Output:
        """Put one image through a plan.

        Args:
            plan: what to do.
            source: the image, (height, width[, channel]), float16 or float32 as the plan says,
                C-contiguous.
            bind: the value of a "value", "key" or "table8" parameter: a NumPy scalar or array.
            timings: is given one entry a launch, in order.
            download: bring results back; False leaves them on the device (for measuring).

        Raises:
            ImageError: the image does not fit into the device's memory.
            DeviceError: a kernel does not compile.
        """
        cl = self._cl
        kernels = self.prepare(plan)
        if len(self._tables) > 32:
            self._tables.clear()
        height, width = source.shape[:2]
        extent = Extent(width, height, self.info.lanes, plan.apron)
        channels = len(plan.source.channels)
        room = extent.rows * width * channels + 3 * extent.lanes
        needed = plan.bytes_per_pixel(extent.lanes) * width * height
        memory = f"on the device, which has {self.info.memory / 2**20:.0f} MiB"
        too_large = f"{width}x{height} pixels need {needed / 2**20:.0f} MiB {memory}"
        if needed > self.info.memory:
            raise ImageError(too_large)
        try:
            if download or "src" not in self._buffers:
                src = self._buffer("src", room * source.itemsize)
                self._upload(src, source)
            events = []
            for kernel, compiled in kernels:
                arguments = [
                    self._argument(p, kernel, plan, extent, bind) for p in kernel.parameters
                ]
                compiled.set_args(*arguments)
                global_size, local_size = self._index_space(kernel, extent)
                events.append(
                    cl.enqueue_nd_range_kernel(self._queue, compiled, global_size, local_size)
                )
            output = Output({}, None, {})
            if download:
                self._download(plan, extent, output)
            self._queue.finish()
        except cl.MemoryError as error:
            raise ImageError(f"{too_large}: {error}") from None
        if timings is not None:
            for (kernel, _), event in zip(kernels, events, strict=True):
                seconds = (event.profile.end - event.profile.start) * 1e-9
                timings.append(Timing(kernel.launch.name, seconds))
        return output

    def _index_space(
        self, kernel: Kernel, extent: Extent
    ) -> tuple[tuple[int, ...], tuple[int, ...]]:
        match kernel.launch:
            case Launch(rows=rows, columns=columns):
                across = round_up(extent.columns, extent.lanes * columns)
                blocks = round_up(across // (extent.lanes * columns), LOCAL_SIZE)
                return (blocks, round_up(extent.height, rows) // rows), (LOCAL_SIZE, 1)
            case Lines():
                longest = round_up(max(extent.width, extent.height), extent.lanes)
                return (round_up(longest // extent.lanes, LOCAL_SIZE),), (LOCAL_SIZE,)
            case Count() | AddUp():
                return (SHARES,), (LOCAL_SIZE,)
            case Find():
                return (1,), (1,)

    def _argument(
        self, parameter: Parameter, kernel: Kernel, plan: Plan, extent: Extent, bind: Bind
    ) -> Any:
        blocks = extent.columns // extent.lanes * (extent.rows // 4)
        match parameter.role:
            case "extent":
                return np.uint32(getattr(extent, parameter.item))
            case "source":
                return self._buffers["src"]
            case "slot":
                return self._buffer(f"slot{parameter.number}", extent.plane_bytes)
            case "encoded":
                assert plan.encoded
                size = extent.width * extent.height * len(plan.encoded.channels)
                return self._buffer("dst", size)
            case "lines":
                # Room for whole blocks of rows and for the last vector.
                longest = max(extent.columns, extent.rows) + 2 * extent.lanes
                return self._buffer(f"lines.{parameter.step}", longest * 4)
            case "sums":
                return self._buffer("sums", blocks * 16)
            case "count":
                return np.uint32(blocks)
            case "shares":
                return self._buffer("shares", SHARES * 32)
            case "counts":
                return self._buffer("counts", SHARES * parameter.number * 4)
            case "histogram":
                return self._buffer("histogram", parameter.number * 4)
            case "found":
                return self._buffer(f"found.{parameter.step}", 16)
            case _:
                value = bind(parameter)
                return self._table(value) if isinstance(value, np.ndarray) else value

    def _buffer(self, name: str, size: int) -> Any:
        """The buffer of that name, made anew only when its size changes."""
        cl = self._cl
        held = self._buffers.pop(name, None)
        if held is None or held.size != size:
            if held is not None:
                held.release()
            if size > self.info.max_buffer:
                raise cl.MemoryError(f"one buffer of {size / 2**20:.0f} MiB is too large for it")
            held = cl.Buffer(self._context, cl.mem_flags.READ_WRITE, size)
        self._buffers[name] = held
        return held

    def _table(self, table: Array) -> Any:
        """A small constant array on the device, uploaded once."""
        cl = self._cl
        if id(table) not in self._tables:
            flags = cl.mem_flags.READ_ONLY | cl.mem_flags.COPY_HOST_PTR
            # The array is held so that its id stays its own.
            self._tables[id(table)] = table, cl.Buffer(self._context, flags, hostbuf=table)
        return self._tables[id(table)][1]

    def _upload(self, buffer: Any, array: Array) -> None:
        self._cl.enqueue_copy(self._queue, buffer, np.ascontiguousarray(array), is_blocking=True)

    def _download(self, plan: Plan, extent: Extent, output: Output) -> None:
        cl = self._cl
        wanted = {image.number: image for _, image in plan.kept}
        if plan.final:
            wanted[plan.final.number] = plan.final
        for number, image in wanted.items():
            output.images[number] = self._planes(plan, image, extent)
        if plan.encoded:
            channels = len(plan.encoded.channels)
            shape = (extent.height, extent.width, channels)[: 2 if channels == 1 else 3]
            output.encoded = np.empty(shape, np.uint8)
            cl.enqueue_copy(self._queue, output.encoded, self._buffers["dst"])
        for launch in plan.launches:
            if isinstance(launch, Find):
                values = np.empty(4, np.float32)
                cl.enqueue_copy(self._queue, values, self._buffers[f"found.{launch.op.step}"])
                output.found[launch.op.step] = values

    def _planes(self, plan: Plan, image: Image, extent: Extent) -> Array:
        """An image from its planes, without the apron: (height, width[, channel]) float32."""
        slots = plan.slots[image.number]
        result = np.empty((extent.height, extent.width, len(slots)), np.float32)
        side = apron_left(plan.apron, extent.lanes)
        rows = extent.rows + 2 * plan.apron
        plane = np.empty(extent.plane_bytes // 4, np.float32)
        for channel, slot in enumerate(slots):
            self._cl.enqueue_copy(self._queue, plane, self._buffers[f"slot{slot}"])
            whole = plane[: rows * extent.pitch].reshape(rows, extent.pitch)
            result[..., channel] = whole[
                plan.apron : plan.apron + extent.height, side : side + extent.width
            ]
        return result[..., 0] if len(slots) == 1 else result

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


def open_device(selector: str | None) -> Device | None:
    """The device that a selector names, as :func:`choose` has it; None for "numpy".

    Raises:
        DeviceError: there is none, none matches, or the one that was asked for cannot be used.
    """
    if selector is not None and selector.lower() == "numpy":
        return None
    return Device(choose(selector, find_devices()))
