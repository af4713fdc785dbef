"""Compiled programs: one per source and device in a process, and a cache on disk.

The source of a kernel depends only on its operations (see :mod:`clpipe.engine.codegen`). Therefore
plans share programs, and so do all :class:`~clpipe.engine.device.Device` objects of one device.
"""

import logging
import re
import threading
import warnings
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from clpipe.base.cache import BoundedCache
from clpipe.base.errors import DeviceError, RequestError
from clpipe.base.system import preserve_signal_handlers
from clpipe.engine.builders import BinaryBuilder, PoclBuilder
from clpipe.engine.cache_folder import (
    POCL_SWITCH,
    cache_folder,
    cache_problem,
    pocl_caches_nothing,
    pocl_folder,
)
from clpipe.engine.discovery import DeviceInfo
from clpipe.engine.ir import Kernel
from clpipe.engine.runtimes import compiler_key, is_pocl
from clpipe.engine.store import Store

# PoCL includes the declarations of all OpenCL functions before each program. The first option makes
# PoCL skip this. The second makes kernels/lib/builtins.h declare the functions that kernels call.
BUILTIN_OPTIONS = ("-D_OPENCL_H_", "-DDECLARED_HERE")
MAX_PROGRAMS = 1024  # the most programs that a process keeps for each device
NOTICE_DELAY = 2.0  # s of compiling after which this is logged
log = logging.getLogger(__name__)
_by_device: dict[int, "Programs"] = {}
_lock = threading.Lock()  # guards _by_device
_notice_logged = threading.Event()
_watchers: list[Callable[[int, int], None]] = []


class Programs:
    """The OpenCL context of a device, and the programs that this process compiled in it.

    Attributes:
        declares: whether clpipe declares OpenCL's functions; see :data:`BUILTIN_OPTIONS`.

    Raises:
        DeviceError: the device cannot be opened.
    """

    def __init__(self, info: DeviceInfo) -> None:
        import pyopencl as cl

        self._cl = cl
        try:
            with preserve_signal_handlers():
                self.context = cl.Context([info.handle])
        except cl.Error as error:
            raise DeviceError(
                f"{info.label} cannot be opened: {error}. Close other programs that use it, or "
                "choose another device."
            ) from None
        self._programs: BoundedCache[Any] = BoundedCache(MAX_PROGRAMS)
        self._lock = threading.Lock()  # lets one thread compile at a time
        self._options = ["-cl-std=CL1.2", "-w"]
        if info.handle.single_fp_config & cl.device_fp_config.CORRECTLY_ROUNDED_DIVIDE_SQRT:
            self._options.append("-cl-fp32-correctly-rounded-divide-sqrt")
        self.declares = is_pocl(info.platform)
        self._builder = builder_for(info, self.context)

    def __len__(self) -> int:
        """The number of programs."""
        return len(self._programs)

    def kernel(self, kernel: Kernel) -> Any:
        """Return a compiled kernel, as a new object whose arguments are not shared.

        Raises:
            RequestError: a user's stage file does not compile. The message contains the compiler's.
            DeviceError: another kernel does not compile.
        """
        with self._lock:
            program = self._programs.get(kernel.source, lambda: self._compile(kernel))
            return self._cl.Kernel(program, kernel.name)

    def _compile(self, kernel: Kernel) -> Any:
        cl = self._cl
        # Not in catch_warnings, because that changes the filters of all threads.
        warnings.filterwarnings("ignore", category=cl.CompilerWarning)
        stage_files = [file for file in kernel.files if Path(file).is_absolute()]
        if self.declares and not stage_files:  # stage files may call any function
            with suppress(cl.Error):
                return self._build(kernel, [*self._options, *BUILTIN_OPTIONS])
        try:
            program = self._build(kernel, self._options)
        except cl.MemoryError:
            raise
        except cl.Error as error:
            text = build_log(str(error))
            if stage_files:
                raise RequestError(f"{stage_files[0]}: does not compile:\n{text}") from None
            raise DeviceError(
                f"the kernel {kernel.launch.name} does not compile:\n{text}"
            ) from None
        self.declares &= bool(stage_files)  # it failed only with clpipe's declarations
        return program

    def _build(self, kernel: Kernel, options: list[str]) -> Any:
        if self._builder:
            return self._builder.build(kernel.source, options)
        return self._cl.Program(self.context, kernel.source).build(options, cache_dir=False)

    def keep(self) -> None:
        """Cache on disk the programs that were compiled and launched since the last call."""
        if self._builder:
            with self._lock:
                self._builder.keep()


def builder_for(info: DeviceInfo, context: Any) -> BinaryBuilder | PoclBuilder | None:
    """Return the builder of a device's programs; None if the driver has its own cache."""
    store = store_of(info)
    if store is None:
        return None
    if is_pocl(info.platform):
        folder = pocl_folder()
        return PoclBuilder(context, store, folder) if folder else None
    return BinaryBuilder(context, store)


def store_of(info: DeviceInfo) -> Store | None:
    """Return the cache of a device's programs; None if the driver has its own cache.

    It contains only programs that the device's runtime can use in this environment.
    """
    from pyopencl.characterize import has_src_build_cache

    if not is_pocl(info.platform) and has_src_build_cache(info.handle):
        return None
    folder = None if pocl_caches_nothing() and is_pocl(info.platform) else cache_folder()
    key = compiler_key(info.handle.platform, info.handle, info.target)
    return Store(folder / "programs" if folder else None, *key)


@dataclass(frozen=True)
class CacheState:
    """The kernel cache on disk.

    Args:
        folder: its folder; None if there is none.
        problem: why kernels that are compiled now cannot be cached; "" if they can.
        bytes: the size of all its files.
        programs: the number of compiled programs, of all environments.
        usable: how many of them the given devices can use in this environment.
    """

    folder: str | None
    problem: str
    bytes: int
    programs: int
    usable: int


def cache_state(devices: Sequence[DeviceInfo]) -> CacheState:
    """Return the state of the kernel cache, as seen from the devices of this environment."""
    folder = cache_folder()
    files = [path for path in folder.rglob("*") if path.is_file()] if folder else []
    stores = [store_of(info) for info in devices if info.handle]
    usable = {store.folder: len(store) for store in stores if store and store.folder}
    return CacheState(
        folder=str(folder) if folder else None,
        problem=cache_problem(),
        bytes=sum(path.stat().st_size for path in files),
        programs=sum(folder / "programs" in path.parents for path in files) if folder else 0,
        usable=sum(usable.values()),
    )


def cache_notice(info: DeviceInfo) -> str:
    """Return in words whether later runs find the kernels that are compiled now, and where."""
    if store_of(info) is None:
        return "the driver caches them"
    if is_pocl(info.platform) and pocl_caches_nothing():
        problem = f"{POCL_SWITCH} switches PoCL's cache off"
    else:
        problem = cache_problem()
    if problem:
        return f"later runs compile them again, because {problem}"
    return f"later runs find them in {cache_folder()}"


def programs_of(info: DeviceInfo) -> Programs:
    """Return the context and programs of a device, which this process shares.

    Raises:
        DeviceError: the device cannot be opened.
    """
    with _lock:
        key = info.handle.int_ptr
        if key not in _by_device:
            _by_device[key] = Programs(info)
        return _by_device[key]


def forget_programs(info: DeviceInfo, broken: Programs) -> None:
    """Remove a broken context, so that the next call of :func:`programs_of` creates a new one."""
    with _lock:
        if _by_device.get(info.handle.int_ptr) is broken:
            del _by_device[info.handle.int_ptr]


@contextmanager
def notice_if_slow(info: DeviceInfo) -> Iterator[None]:
    """Log once per process that kernels are compiled, if it takes over :data:`NOTICE_DELAY`.

    The logger is ``clpipe.engine.programs``. The level is INFO.
    """

    def announce() -> None:
        if not _notice_logged.is_set():
            _notice_logged.set()
            log.info("compiling kernels for %s; %s", info.label, cache_notice(info))

    timer = threading.Timer(NOTICE_DELAY, announce)
    timer.daemon = True
    timer.start()
    try:
        yield
    finally:
        timer.cancel()


@contextmanager
def watching_compilation(watcher: Callable[[int, int], None]) -> Iterator[None]:
    """Call a function with the number of compiled kernels and of all kernels, from any thread."""
    _watchers.append(watcher)
    try:
        yield
    finally:
        _watchers.remove(watcher)


def notify_watchers(compiled: int, total: int) -> None:
    """Report to all watchers how many kernels of a plan are compiled."""
    for watcher in tuple(_watchers):
        watcher(compiled, total)


def build_log(text: str) -> str:
    """Return the compiler's messages from pyopencl's error message.

    >>> build_log("failed\\n\\nBuild on <x>:\\n\\nerror: a.cl:2:7: no\\n\\n(options: -a)")
    'error: a.cl:2:7: no'
    """
    found = re.sub(r"\n*\(options: .*", "", text.partition(">:\n")[2], flags=re.DOTALL)
    lines = [line for line in found.splitlines() if "failed to build the program" not in line]
    return "\n".join(lines).strip() or text
