"""What only some systems have, and what stands in for it on the others.

Elsewhere in clpipe nothing is needed that Linux, macOS and Windows do not all have. What is there
is used, whichever system it is.
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
from typing import Any, BinaryIO


def _optional(name: str) -> Any:
    """A module of the standard library; None where this system has none."""
    try:
        return importlib.import_module(name)
    except ImportError:
        return None


fcntl, msvcrt, resource = (_optional(name) for name in ("fcntl", "msvcrt", "resource"))

# Bytes of a file that can be held, of which none need be there. Windows's C runtime counts with
# 31 bits.
HOLDABLE = 2**40 if fcntl else 2**30

_ARENA_MAX = -8  # of glibc's mallopt: the most heaps
_SYNC_FILE_RANGE_WRITE = 2  # of Linux: begin with what was not begun

# Without O_BINARY, Windows writes "\r\n" for "\n".
_PLAIN = sum(getattr(os, name, 0) for name in ("O_NOFOLLOW", "O_NONBLOCK", "O_BINARY"))


def open_plain(path: Path, flags: int) -> int:
    """A descriptor of a file, as ``os.open``, but following no link and waiting for no pipe.

    Raises:
        OSError: it cannot be opened, or is a link.
    """
    if not hasattr(os, "O_NOFOLLOW") and path.is_symlink():
        raise OSError(errno.ELOOP, os.strerror(errno.ELOOP), str(path))
    return os.open(path, flags | _PLAIN, 0o666)


def hold(file: int, first: int, length: int) -> bool:
    """Hold a range of a file's bytes against other processes, until the file is closed.

    The system lets go of it when the process ends, however that comes about.

    Args:
        file: a descriptor, open for writing.
        first: the first byte.
        length: how many; the last one is within :data:`HOLDABLE`.

    Returns:
        False where another process holds one of them.

    Raises:
        OSError: there are no such locks on this system, or in this file system.
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


def use(file: int, alone: bool = False, wait: bool = True) -> bool:
    """Share a file with other processes that use it, or have it alone, until it is closed.

    The system lets go of it when the process ends. It is another lock than that of :func:`hold`,
    and nothing where the system or the file system has none.

    Args:
        file: a descriptor.
        alone: whether to have it alone.
        wait: whether to wait until the others let that be.

    Returns:
        Whether it is had; True on a system without such locks, False in a file system without them.
    """
    if not fcntl:
        return True
    try:
        how = fcntl.LOCK_EX if alone else fcntl.LOCK_SH
        fcntl.flock(file, how if wait else how | fcntl.LOCK_NB)
    except OSError:
        return False
    return True


def writable_by_others(folder: Path) -> str:
    """Why others than this user may write to a folder, in words; "" where they may not.

    Raises:
        OSError: the folder cannot be looked at.
    """
    if not hasattr(os, "geteuid"):
        return ""
    status = folder.stat()
    if status.st_uid != os.geteuid():
        return f"it belongs to another user (number {status.st_uid})"
    mode = stat.S_IMODE(status.st_mode)
    return f"others may write to it (mode {mode:04o})" if mode & 0o022 else ""


def let_go(path: Path, file: int, first: int, length: int) -> None:
    """Close a file of which this process holds a range, and remove it if no other holds any.

    Args:
        path: the file.
        file: its descriptor.
        first, length: the range, as in :func:`hold`.
    """
    with contextlib.suppress(OSError):
        if fcntl:
            if hold(file, 0, HOLDABLE):
                path.unlink()
        elif msvcrt:
            os.lseek(file, first, os.SEEK_SET)
            msvcrt.locking(file, msvcrt.LK_UNLCK, length)
    os.close(file)
    if msvcrt and not fcntl:
        with contextlib.suppress(OSError):  # Windows refuses while another process has it open
            path.unlink()


def reserve(file: BinaryIO, size: int) -> None:
    """See that a new file can take a number of bytes.

    Raises:
        OSError: it cannot.
    """
    if hasattr(os, "posix_fallocate"):
        os.posix_fallocate(file.fileno(), 0, size)
    else:
        _check_room(file.name, size)


def _check_room(path: str, size: int) -> None:
    """See that a number of bytes are free where a path lies.

    Raises:
        OSError: they are not.
    """
    if shutil.disk_usage(path).free < size:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))


def forbids_programs(folder: Path) -> bool:
    """Whether no library in a folder can be loaded ("noexec"), as far as the system says.

    Raises:
        OSError: the folder cannot be looked at.
    """
    if not hasattr(os, "statvfs"):
        return False
    return bool(os.statvfs(folder).f_flag & getattr(os, "ST_NOEXEC", 0))  # macOS lacks the name


@contextlib.contextmanager
def passing_file(size: int) -> Iterator[str]:
    """The path of a file for a library to write; it is gone afterwards.

    It is in memory where the system has such files, else in the folder for temporary files.

    Args:
        size: bytes that must be free in that folder.

    Raises:
        OSError: they are not, or there is no such folder.
    """
    if hasattr(os, "memfd_create"):
        memory = os.memfd_create("passing")
        try:
            yield f"/proc/self/fd/{memory}"
        finally:
            os.close(memory)
        return
    with tempfile.TemporaryDirectory(prefix="clpipe-", ignore_cleanup_errors=True) as folder:
        _check_room(folder, size)
        yield os.path.join(folder, "passing")


def largest_file() -> int | None:
    """The most bytes that a file of this process may have (``ulimit -f``); None without a limit."""
    return _limit("RLIMIT_FSIZE")


def address_space() -> int | None:
    """The most bytes of addresses of this process (``ulimit -v``); None without a limit."""
    return _limit("RLIMIT_AS")


def _limit(name: str) -> int | None:
    """The limit that the system sets this process; None where it sets none."""
    if not resource:
        return None
    limit = int(resource.getrlimit(getattr(resource, name))[0])
    return None if limit == resource.RLIM_INFINITY else limit


def save_addresses() -> None:
    """Have all threads of this process, and of its children, share one heap.

    The C library reserves 64 MiB of addresses for the heap of each thread, of which it uses little.
    """
    os.environ["MALLOC_ARENA_MAX"] = "1"
    with contextlib.suppress(OSError, TypeError, AttributeError):  # another C library
        _libc().mallopt(_ARENA_MAX, 1)


def give_back_memory() -> None:
    """Give memory that was freed, and that the C library keeps for later, back to the system."""
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
def kept_signals() -> Iterator[None]:
    """Have signals go where they went before, whatever a library that is begun inside does.

    A compiler in the process (LLVM in PoCL) takes them over at its first use, to remove its files,
    and passes them on once; a second one that comes meanwhile ends the process where it stands.

    Only the main thread can do so; in any other nothing is done.
    """
    before = {number: signal.getsignal(number) for number in signal.valid_signals()}
    try:
        yield
    finally:
        if threading.current_thread() is threading.main_thread():
            for number, handler in before.items():
                if callable(handler) or handler is signal.SIG_IGN:
                    signal.signal(number, handler)


def bring_to_disk(folder: Path) -> None:
    """Have the names in a folder outlive a loss of power; nothing on Windows, which opens none.

    Raises:
        OSError: its file system cannot do that.
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
    """The C library.

    Raises:
        TypeError: this system does not give it so.
    """
    return ctypes.CDLL(None)


def file_to_disk(path: Path) -> None:
    """Have a file's bytes outlive a loss of power.

    Raises:
        OSError: they cannot be brought to the disk.
    """
    with open(path, "r+b", buffering=0) as file:
        os.fsync(file.fileno())


def begin_writing(path: Path) -> None:
    """Begin to bring a file's bytes to the disk, and do not wait; nothing where that is unknown.

    Of several files the disk then makes one piece of work.
    """
    with contextlib.suppress(OSError, TypeError, AttributeError):  # another C library
        begin = _libc().sync_file_range
        with open(path, "r+b", buffering=0) as file:
            whole = ctypes.c_int64(0), ctypes.c_int64(0)
            begin(file.fileno(), *whole, _SYNC_FILE_RANGE_WRITE)


def processors() -> int:
    """How many processors this process may run on; all, where the system does not tell it."""
    return len(processor_numbers()) or os.cpu_count() or 1


def processor_numbers() -> list[int]:
    """The processors that this process may run on; none where the system does not tell it."""
    if hasattr(os, "sched_getaffinity"):
        return sorted(os.sched_getaffinity(0))
    return []


def stay_on(numbers: Collection[int]) -> None:
    """Have all threads of this process that start from now on stay on some processors.

    Nothing happens where the system cannot do it, or has taken one of them away.
    """
    if hasattr(os, "sched_setaffinity"):
        with contextlib.suppress(OSError):
            os.sched_setaffinity(0, numbers)
