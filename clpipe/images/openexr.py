"""Uses the OpenEXR package, which needs half of OpenImageIO's time and memory, and writes any type.

Only this module imports it. The package decodes every channel of every part. It reports a damaged
part on standard output, and raises no exception.
"""

import contextlib
import sys
import threading
from collections import deque
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from clpipe.base.cpu_time import CpuTimer
from clpipe.base.types import Array
from clpipe.images.exr_header import read_header

MAX_EXTRA = 2  # the memory of all channels, relative to the memory of the requested channels


def open_exr(path: Path, header_only: bool = False, separate: bool = True) -> Any:
    """Return the file as an ``OpenEXR.File``, without parts whose pixels are damaged.

    Args:
        path: the file.
        header_only: whether to skip the pixels.
        separate: whether each channel is a plane; otherwise, R, G and B of a layer are interleaved.

    Raises:
        Exception: the file is damaged. The C++ library raises many types of exceptions.
    """
    import OpenEXR

    with _discard_stdout():
        return OpenEXR.File(
            str(path), separate_channels=separate, header_only=header_only, num_threads=1
        )


def read_channels(path: Path, names: Sequence[str], shape: tuple[int, int]) -> Array | None:
    """Return channels of an OpenEXR file as stored: (rows, columns, channel), float16 or float32.

    R, G and B without alpha are interleaved in memory. For other channels, the array is a view of
    consecutive planes.

    Args:
        path: the file, whose header OpenImageIO has accepted.
        names: the names of the channels in the file.
        shape: rows and columns of its data window.

    Returns:
        The samples; None if OpenImageIO must read the file, because it is unusual or damaged, or
        other channels would take too much time and memory.
    """
    header = read_header(path, shape)
    if header is None or not header.channels.keys() >= set(names):
        return None
    types = header.channels
    dtype = types[names[0]]
    size = sum(each.itemsize for each in types.values())
    if {types[name] for name in names} != {dtype} or dtype.kind != "f":
        return None
    if size > MAX_EXTRA * len(names) * dtype.itemsize:
        return None
    layer = names[0].removesuffix("R")
    is_rgb = list(names) == [layer + colour for colour in "RGB"] and layer + "A" not in types
    try:
        channels = open_exr(path, separate=not is_rgb).parts[0].channels
        if is_rgb:
            pixels = channels[layer.removesuffix(".") or "RGB"].pixels
        else:
            pixels = _join_planes(channels, names, dtype)
    except Exception:  # OpenImageIO reports the error
        return None
    return pixels if (pixels.shape, pixels.dtype) == ((*shape, len(names)), dtype) else None


def _join_planes(channels: dict[str, Any], names: Sequence[str], dtype: np.dtype[Any]) -> Array:
    """Return planes as one array, (rows, columns, channel). Each is freed after it is copied."""
    for name in channels.keys() - set(names):
        del channels[name]
    shape = channels[names[0]].pixels.shape
    if len(names) == 1:
        return channels[names[0]].pixels[..., np.newaxis]
    planes = np.empty((len(names), *shape), dtype)
    for plane, name in zip(planes, names, strict=True):
        plane[...] = channels.pop(name).pixels
    return planes.transpose(1, 2, 0)


@CpuTimer("encode")
def write_channels(path: str, planes: Mapping[str, Array], attributes: Mapping[str, str]) -> None:
    """Write an OpenEXR file with ZIP compression.

    Args:
        path: the path to write to.
        planes: (rows, columns) float16, float32 or uint32, by the names of the channels.
        attributes: text attributes of the header.

    Raises:
        OSError: the file cannot be written.
    """
    import OpenEXR

    header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage, **attributes}
    channels = {name: np.ascontiguousarray(plane) for name, plane in planes.items()}
    try:
        with _discard_stdout():
            OpenEXR.File(header, channels, num_threads=1).write(path)
    except OSError:
        raise
    except Exception as error:  # the C++ library raises many types of exceptions
        raise OSError(0, str(error)) from None


class _FilteredStdout:
    """Standard output, except for the output of threads in :func:`_discard_stdout`."""

    def __init__(self, stream: Any) -> None:
        self.stream = stream

    def write(self, text: str) -> int:
        return len(text) if hasattr(_thread, "is_silent") else self.stream.write(text)

    def __getattr__(self, name: str) -> Any:
        return getattr(self.stream, name)


_thread = threading.local()
_lock = threading.Lock()  # guards _silent, and the replacement of sys.stdout
_silent: list[threading.Thread] = []
# Replacements of sys.stdout. They stay in memory, because print() in another thread may still use
# one after sys.stdout has changed, without a reference of its own (CPython issue 130163).
_kept: deque[_FilteredStdout] = deque(maxlen=16)


@contextlib.contextmanager
def _discard_stdout() -> Iterator[None]:
    """Discard what this thread writes to standard output. Other threads are not affected."""
    with _lock:
        if not _silent and sys.stdout is not None:
            if not _kept or _kept[-1].stream is not sys.stdout:
                _kept.append(_FilteredStdout(sys.stdout))
            sys.stdout = _kept[-1]
        _silent.append(threading.current_thread())
    _thread.is_silent = True
    try:
        yield
    finally:
        del _thread.is_silent
        with _lock:
            _silent.pop()
            if not _silent and isinstance(sys.stdout, _FilteredStdout):
                sys.stdout = sys.stdout.stream
