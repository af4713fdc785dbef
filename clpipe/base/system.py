"""Functions that only some operating systems have, and their substitutes on others.

All other modules need only what Linux, macOS and Windows have in common. The functions test for
each feature, not for the name of the system.
"""

import contextlib
import ctypes
import errno
import importlib
import os
import shutil
import signal
import stat
import tempfile
import threading
from collections.abc import Collection, Iterator
from functools import cache
from pathlib import Path
from typing import IO, Any


def _optional(name: str) -> Any:
    """Return a module of the standard library; None if this system lacks it."""
    try:
        return importlib.import_module(name)
    except ImportError:
        return None


fcntl, msvcrt, resource = (_optional(name) for name in ("fcntl", "msvcrt", "resource"))

# Bytes of a file that can be locked, also after its end. Windows's C runtime counts with 31 bits.
LOCKABLE_BYTES = 2**40 if fcntl else 2**30

_ARENA_MAX = -8  # mallopt's parameter for the largest number of heaps in glibc
_SYNC_FILE_RANGE_WRITE = 2  # Linux: start to write all dirty pages that are not being written

# Without O_BINARY, Windows writes "\r\n" for "\n".
_OPEN_FLAGS = sum(getattr(os, name, 0) for name in ("O_NOFOLLOW", "O_NONBLOCK", "O_BINARY"))


def open_plain(path: Path, flags: int) -> int:
    """Open a file like ``os.open``, but without following links or waiting for pipes.

    Returns:
        The file descriptor.

    Raises:
        OSError: the file cannot be opened, or is a link.
    """
    if not hasattr(os, "O_NOFOLLOW") and path.is_symlink():
        raise OSError(errno.ELOOP, os.strerror(errno.ELOOP), str(path))
    return os.open(path, flags | _OPEN_FLAGS, 0o666)


def lock_range(file: int, first: int, length: int) -> bool:
    """Lock a range of a file's bytes against other processes, until the file is closed.

    The system also releases the lock whenever the process ends.

    Args:
        file: a descriptor, open for writing.
        first: the first byte.
        length: the number of bytes. The range must end within :data:`LOCKABLE_BYTES` bytes.

    Returns:
        False if another process has locked a part of the range.

    Raises:
        OSError: this system or file system has no such locks.
    """
    try:
        if fcntl:
            fcntl.lockf(file, fcntl.LOCK_EX | fcntl.LOCK_NB, length, first)
        elif msvcrt:
            os.lseek(file, first, os.SEEK_SET)
            msvcrt.locking(file, msvcrt.LK_NBLCK, length)
        else:
            raise OSError(errno.ENOLCK, os.strerror(errno.ENOLCK))
    except OSError as error:
        if error.errno in (errno.EACCES, errno.EAGAIN):
            return False
        raise
    return True


def lock_file(file: int, exclusive: bool = False, wait: bool = True) -> bool:
    """Lock a whole file, shared or exclusively, until the file is closed.

    The system also releases the lock when the process ends. Locks of :func:`lock_range` do not
    affect it.

    Args:
        file: a descriptor.
        exclusive: whether the lock is exclusive.
        wait: whether to wait until other processes release their locks.

    Returns:
        Whether the file is locked. True on a system without such locks, and False in a file system
        without them.
    """
    if not fcntl:
        return True
    try:
        operation = fcntl.LOCK_EX if exclusive else fcntl.LOCK_SH
        fcntl.flock(file, operation if wait else operation | fcntl.LOCK_NB)
    except OSError:
        return False
    return True


def writable_by_others(folder: Path) -> str:
    """Return why other users may write to a folder, in words; "" if they may not.

    Raises:
        OSError: the folder's status cannot be read.
    """
    if not hasattr(os, "geteuid"):
        return ""
    status = folder.stat()
    if status.st_uid != os.geteuid():
        return f"it belongs to another user (number {status.st_uid})"
    mode = stat.S_IMODE(status.st_mode)
    return f"others may write to it (mode {mode:04o})" if mode & 0o022 else ""


def close_and_remove(path: Path, file: int, first: int, length: int) -> None:
    """Close a file with a range that this process has locked, and remove it if no other has locks.

    Args:
        path: the file.
        file: its descriptor.
        first: the first byte, as for :func:`lock_range`.
        length: the number of bytes.
    """
    with contextlib.suppress(OSError):
        if fcntl:
            if lock_range(file, 0, LOCKABLE_BYTES):
                path.unlink()
        elif msvcrt:
            os.lseek(file, first, os.SEEK_SET)
            msvcrt.locking(file, msvcrt.LK_UNLCK, length)
    os.close(file)
    if msvcrt and not fcntl:
        # On Windows, this fails if another process has opened the file.
        with contextlib.suppress(OSError):
            path.unlink()


def reserve(file: IO[bytes], size: int) -> None:
    """Reserve space for a number of bytes in a new file, or check that it is free.

    Raises:
        OSError: the disk has too little space.
    """
    if hasattr(os, "posix_fallocate"):
        os.posix_fallocate(file.fileno(), 0, size)
    else:
        _check_free_space(file.name, size)


def _check_free_space(path: str, size: int) -> None:
    """Check that the disk of a path has a number of bytes free.

    Raises:
        OSError: the disk has too little space.
    """
    if shutil.disk_usage(path).free < size:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))


def forbids_programs(folder: Path) -> bool:
    """Return whether a folder's file system forbids loading libraries ("noexec").

    Returns:
        False if the system cannot report this.

    Raises:
        OSError: the file system's status cannot be read.
    """
    if not hasattr(os, "statvfs"):
        return False
    return bool(os.statvfs(folder).f_flag & getattr(os, "ST_NOEXEC", 0))  # macOS lacks the name


@contextlib.contextmanager
def temporary_file(size: int) -> Iterator[str]:
    """Yield the path of a temporary file for a library to write. It is removed afterwards.

    The file is in memory if the system supports that, else in the folder for temporary files.

    Args:
        size: the bytes that must be free in that folder.

    Raises:
        OSError: the folder is missing or has too little space.
    """
    if hasattr(os, "memfd_create"):
        memory = os.memfd_create("passing")
        try:
            yield f"/proc/self/fd/{memory}"
        finally:
            os.close(memory)
        return
    with tempfile.TemporaryDirectory(prefix="clpipe-", ignore_cleanup_errors=True) as folder:
        _check_free_space(folder, size)
        yield os.path.join(folder, "passing")


def max_file_size() -> int | None:
    """Return the file size limit of this process in bytes (``ulimit -f``); None without a limit."""
    return _limit("RLIMIT_FSIZE")


def max_address_space() -> int | None:
    """Return the address space limit of this process in bytes (``ulimit -v``); None without one."""
    return _limit("RLIMIT_AS")


def _limit(name: str) -> int | None:
    """Return a resource limit of this process; None without a limit."""
    if not resource:
        return None
    limit = int(resource.getrlimit(getattr(resource, name))[0])
    return None if limit == resource.RLIM_INFINITY else limit


def use_single_heap() -> None:
    """Make all threads of this process and of its children share one heap.

    Otherwise glibc reserves 64 MiB of address space for each thread's heap and uses little of it.
    """
    os.environ["MALLOC_ARENA_MAX"] = "1"
    with contextlib.suppress(OSError, TypeError, AttributeError):  # the C library is not glibc
        _libc().mallopt(_ARENA_MAX, 1)


def trim_memory() -> None:
    """Return freed memory that the C library keeps for later to the system."""
    with contextlib.suppress(OSError, TypeError, AttributeError):  # another C library
        _libc().malloc_trim(0)


@contextlib.contextmanager
def blocked_signals(numbers: Collection[int]) -> Iterator[None]:
    """Block signals in this thread until the ``with`` block ends.

    A process that is started in the block inherits this for good, so it never gets the signals.
    Windows cannot block signals, so this does nothing there.
    """
    if not hasattr(signal, "pthread_sigmask"):
        yield
        return
    before = signal.pthread_sigmask(signal.SIG_BLOCK, numbers)
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


@contextlib.contextmanager
def preserve_signal_handlers() -> Iterator[None]:
    """Restore this process's signal handlers after the ``with`` block.

    LLVM, which compiles for PoCL in this process, installs its own handlers at its first use, to
    remove its files. These pass on only one signal. A second signal would kill the process.

    Only the main thread can restore handlers. In other threads this does nothing.
    """
    before = {number: signal.getsignal(number) for number in signal.valid_signals()}
    try:
        yield
    finally:
        if threading.current_thread() is threading.main_thread():
            for number, handler in before.items():
                if callable(handler) or handler is signal.SIG_IGN:
                    signal.signal(number, handler)


def sync_folder_entries(folder: Path) -> None:
    """Synchronise a folder's entries to the disk. Windows cannot open folders, so it skips this.

    Raises:
        OSError: the file system cannot do that.
    """
    if not hasattr(os, "O_DIRECTORY"):
        return
    descriptor = os.open(folder, os.O_RDONLY | os.O_DIRECTORY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


@cache
def _libc() -> ctypes.CDLL:
    """Return the C library.

    Raises:
        TypeError: this system cannot load it in this way.
    """
    return ctypes.CDLL(None)


def sync_file(path: Path) -> None:
    """Synchronise a file's bytes to the disk.

    Raises:
        OSError: the bytes cannot be written to the disk.
    """
    with open(path, "r+b", buffering=0) as file:
        os.fsync(file.fileno())


def start_writeback(path: Path) -> None:
    """Start to write a file's bytes to the disk without waiting, if the system supports that.

    The disk can then combine the writes of several files.
    """
    with contextlib.suppress(OSError, TypeError, AttributeError):  # another C library
        sync_file_range = _libc().sync_file_range
        with open(path, "r+b", buffering=0) as file:
            whole = ctypes.c_int64(0), ctypes.c_int64(0)
            sync_file_range(file.fileno(), *whole, _SYNC_FILE_RANGE_WRITE)


def processors() -> int:
    """Return the number of processors that this process may use; all if the system does not say."""
    return len(processor_numbers()) or os.cpu_count() or 1


def processor_numbers() -> list[int]:
    """Return the processors that this process may use; an empty list if the system does not say."""
    if hasattr(os, "sched_getaffinity"):
        return sorted(os.sched_getaffinity(0))
    return []


def bind_to_processors(numbers: Collection[int]) -> None:
    """Bind the threads that this process starts from now on to some processors.

    This does nothing if the system cannot do it, or if one of the processors is not available.
    """
    if hasattr(os, "sched_setaffinity"):
        with contextlib.suppress(OSError):
            os.sched_setaffinity(0, numbers)
