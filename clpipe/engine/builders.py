"""Programs: compiled, or loaded from the cache on disk.

Runtimes do not validate cached programs; a truncated library crashes PoCL. Therefore clpipe reads
and validates the cache itself.

PoCL has no call that loads compiled kernels; it maps libraries from a folder. Therefore each
process has a separate folder for PoCL, and the cache stores each program's part of this folder.
"""

import io
import logging
import os
import re
import threading
import zipfile
from collections.abc import Iterator
from contextlib import suppress
from functools import cache
from pathlib import Path
from typing import Any

from clpipe.base.errors import DeviceError, ImageError
from clpipe.base.files import unsynced_files, write_new
from clpipe.base.memory import format_bytes, free_memory
from clpipe.base.process_folder import MIN_FREE_SPACE, has_free_space
from clpipe.engine.cache_folder import cache_problem
from clpipe.engine.store import Store

COMPILER_MEMORY = 112 << 20  # bytes of memory; measured: 86 to 105 MiB for the default chain
log = logging.getLogger(__name__)


class BinaryBuilder:
    """Builds programs with a runtime that can return and load binaries.

    Args:
        context: a ``pyopencl.Context`` of one device.
        store: the cache of binaries.
    """

    def __init__(self, context: Any, store: Store) -> None:
        self._context = context
        self._store = store

    def build(self, source: str, options: list[str]) -> Any:
        """Return the ``pyopencl.Program``, from the cached binary if the runtime accepts it.

        Raises:
            pyopencl.Error: it does not compile.
        """
        import pyopencl as cl

        if cached := self._store.load(source, *options):
            with suppress(cl.Error):
                program = cl.Program(self._context, self._context.devices, [cached])
                return program.build(options, cache_dir=False)
        program = cl.Program(self._context, source).build(options, cache_dir=False)
        with suppress(cl.Error):
            (binary,) = program.get_info(cl.program_info.BINARIES)
            if binary:
                store_compiled(self._store, binary, source, *options)
        return program

    def keep(self) -> None:
        """Do nothing, because :meth:`build` has stored the binaries."""


def store_compiled(store: Store, data: bytes, *key: str) -> None:
    """Store a program that this process compiled. Log each at the level DEBUG, and a failure."""
    log.debug("compiled a program that was not in the cache")
    if not store.keep(data, *key) and store.folder and not cache_problem():
        _warn_not_stored(store.folder.parent)


@cache
def _warn_not_stored(folder: Path) -> None:
    """Log once that compiled kernels could not be stored, although the folder is writable."""
    log.warning(
        "%s: compiled kernels could not be written here, so later runs compile them again. "
        "Free some space on this disk.",
        folder,
    )


class PoclBuilder:
    """Builds programs with PoCL, which keeps compiled programs in a folder.

    PoCL has a subfolder for each program. Its name is a digest that only PoCL can compute. PoCL
    adds a library at the first launch of each local size, so programs are stored after that.

    Args:
        context: a ``pyopencl.Context``.
        store: the cache of the contents of PoCL's folder.
        folder: PoCL's folder, which only this process uses.
    """

    # One build at a time, because what a build added to the folder is found by comparing listings.
    _build_lock = threading.Lock()
    _has_compiled = False  # whether this process has already allocated the compiler's memory

    def __init__(self, context: Any, store: Store, folder: Path) -> None:
        self._context = context
        self._store = store
        self._folder = folder
        # The folder of each program and its stored files, by source and options.
        self._built: dict[tuple[str, tuple[str, ...]], tuple[str, frozenset[str]]] = {}

    def build(self, source: str, options: list[str]) -> Any:
        """Return the ``pyopencl.Program``, after unpacking the cached program to PoCL's folder.

        Raises:
            pyopencl.Error: the program does not compile.
            DeviceError: there is too little space to compile, so PoCL would crash the process.
        """
        import pyopencl as cl

        with self._build_lock:
            before = _list_programs(self._folder)
            if cached := self._store.load(source, *options):
                _unpack(cached, self._folder)
            unpacked = _list_programs(self._folder) - before
            stored = {name: _list_files(self._folder / name) for name in unpacked}
            if not unpacked:
                self._check_resources()
            program = cl.Program(self._context, source).build(options, cache_dir=False)
            added = _list_programs(self._folder) - before
            # PoCL adds a folder next to an unpacked one if it cannot use it.
            if len(used := (added - unpacked) or unpacked) == 1:
                (name,) = used
                self._built[source, tuple(options)] = name, stored.get(name, frozenset())
        return program

    def _check_resources(self) -> None:
        """Check that PoCL can compile. PoCL crashes the process if the disk or memory is full.

        Raises:
            DeviceError: there is too little disk space or memory, or the folder was removed.
        """
        try:
            has_space = has_free_space(self._folder.parent)
        except OSError as error:
            raise DeviceError(
                f"{self._folder.parent}: PoCL's folder was removed while this process used it "
                f"({error.strerror}). Exclude it from clean-ups of temporary files and start again."
            ) from None
        if not has_space:
            raise DeviceError(
                f"{self._folder}: PoCL needs {MIN_FREE_SPACE >> 20} MiB of free space there to "
                "compile. Free some space, or set TMPDIR to another folder for temporary files."
            )
        free = None if self._has_compiled else free_memory()
        if free and free.bytes < COMPILER_MEMORY:
            raise DeviceError(
                f"PoCL's compiler needs about {format_bytes(COMPILER_MEMORY)} of memory, but "
                f"only {format_bytes(free.bytes)} is available ({free.limit}). "
                "Allow more for the first run."
            )
        PoclBuilder._has_compiled = True

    def keep(self) -> None:
        """Store the files that PoCL has compiled since the programs were built."""
        with self._build_lock:
            for (source, options), (name, stored) in list(self._built.items()):
                if _list_files(self._folder / name) - stored:
                    if cached := self._store.load(source, *options):  # of a simultaneous process
                        _unpack(cached, self._folder)
                    files = _list_files(self._folder / name)
                    data = _pack(self._folder, name, files)
                    store_compiled(self._store, data, source, *options)
                    self._built[source, options] = name, files


PROGRAM_NAME = re.compile(r"[A-Z]{2}/[A-Z]+")
FILE_NAME = re.compile(rf"{PROGRAM_NAME.pattern}(/(?!\.\.?/)[^/\\\0]+)+")
ACCESS_TIME_FILE = "last_accessed"  # PoCL writes this file at each use, and never reads it


def _list_programs(folder: Path) -> frozenset[str]:
    """Return the names of the programs in PoCL's folder, in the form "AB/CDE..."."""
    groups = _list_directory(folder)
    found = (f"{group}/{name}" for group in groups for name in _list_directory(folder / group))
    return frozenset(name for name in found if PROGRAM_NAME.fullmatch(name))


def _list_directory(folder: Path) -> list[str]:
    try:
        return os.listdir(folder)
    except OSError:  # it is a file, or does not exist yet
        return []


def _list_files(program: Path) -> frozenset[str]:
    """Return the names of a program's files, relative to its folder."""
    return frozenset(
        os.path.relpath(os.path.join(directory, name), program)
        for directory, _, names in os.walk(program)
        for name in names
        if name != ACCESS_TIME_FILE
    )


def _pack(folder: Path, program: str, files: frozenset[str]) -> bytes:
    """Return the files of a program as a ZIP archive, with names relative to PoCL's folder."""
    memory = io.BytesIO()
    with zipfile.ZipFile(memory, "w") as archive:
        for name in sorted(files):
            with suppress(OSError):
                data = (folder / program / name).read_bytes()
                archive.writestr(zipfile.ZipInfo(f"{program}/{name}"), data)
    return memory.getvalue()


def _unpack(data: bytes, folder: Path) -> None:
    """Write the files of a packed program that are missing in PoCL's folder.

    Existing libraries may be mapped and running. Writing to them would crash the process (SIGBUS).
    """
    with (
        suppress(ImageError, zipfile.BadZipFile),
        unsynced_files(),
        zipfile.ZipFile(io.BytesIO(data)) as archive,
    ):
        for name, content in _valid_files(archive):
            if not (folder / name).exists():
                write_new(folder / name, content)


def _valid_files(archive: zipfile.ZipFile) -> Iterator[tuple[str, bytes]]:
    """Yield the name and the bytes of each file with a valid name in PoCL's folder."""
    for info in archive.infolist():
        if FILE_NAME.fullmatch(info.filename):
            yield info.filename, archive.read(info)
