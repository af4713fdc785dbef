"""Uses the OpenEXR package, which needs half of OpenImageIO's time and memory, and writes any type.

Only this module imports it. The package decodes every channel of every part. It reports a damaged
part on standard output, and raises no exception.
"""

import os
import struct
import sys
import threading
from collections import deque
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

import numpy as np

from clpipe.base.cpu_time import CpuTimer
from clpipe.base.types import Array

# The types that are read, by OpenImageIO's names.
DTYPES: dict[str, np.dtype[Any]] = {"half": np.dtype(np.float16), "float": np.dtype(np.float32)}
HEADER_BYTES = 1 << 16  # bytes; longer headers are unusual
# Rows of a chunk, by OpenImageIO's name of the compression; others have 1.
CHUNK_ROWS = {"zip": 16, "pxr24": 16, "piz": 32, "b44": 32, "b44a": 32, "dwaa": 32, "dwab": 256}
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


def read_channels(path: Path, file: Any, indices: Sequence[int]) -> Array | None:
    """Return channels of an OpenEXR file as stored: (rows, columns, channel), float16 or float32.

    R, G and B without alpha are interleaved in memory. For other channels, the array is a view of
    consecutive planes.

    Args:
        path: the file.
        file: the open ``oiio.ImageInput``, at its first part.
        indices: the numbers of the channels.

    Returns:
        The samples; None if OpenImageIO must read the file, because it has several parts or is
        damaged, or because other channels would take too much time and memory.
    """
    spec = file.spec()
    formats = spec.channelformats or [spec.format] * spec.nchannels
    types = {str(formats[i]) for i in indices}
    dtype = DTYPES.get(types.pop()) if len(types) == 1 else None
    stored = sum(each.size() for each in formats)
    if dtype is None or stored > MAX_EXTRA * len(indices) * dtype.itemsize:
        return None
    if _has_several_parts(file) or not _is_usual(path, spec):
        return None
    names = [spec.channelnames[i] for i in indices]
    layer = names[0].removesuffix("R")
    is_rgb = names == [layer + colour for colour in "RGB"] and layer + "A" not in spec.channelnames
    try:
        channels = open_exr(path, separate=not is_rgb).parts[0].channels
        if is_rgb:
            pixels = channels[layer.removesuffix(".") or "RGB"].pixels
        else:
            pixels = _join_planes(channels, names, dtype)
    except Exception:  # OpenImageIO reports the error
        return None
    shape = spec.height, spec.width, len(names)
    return pixels if (pixels.shape, pixels.dtype) == (shape, dtype) else None


def _has_several_parts(file: Any) -> bool:
    """Return whether an open file has several parts; it is at its first one."""
    found = file.seek_subimage(1, 0)
    file.seek_subimage(0, 0)
    file.geterror()  # clears the error: the second part need not exist
    return bool(found)


def _is_usual(path: Path, spec: Any) -> bool:
    """Return whether the package reads a file well: its chunks are complete and in order.

    The package prints errors of other files. It also decompresses an idmanifest in the header, to
    up to a thousand times its size.
    """
    with suppress(OSError, IndexError, ValueError, struct.error), path.open("rb") as file:
        start, end = file.read(HEADER_BYTES), 8
        while start[end]:
            type_ = start.index(0, end) + 1
            size = start.index(0, type_) + 1
            if start.startswith(b"idmanifest", type_):
                return False
            end = size + 4 + struct.unpack_from("<I", start, size)[0]
        rows = CHUNK_ROWS.get(str(spec.getattribute("compression")).partition(":")[0], 1)
        columns, leader = spec.width, 8
        if spec.tile_width:
            columns, rows, leader = spec.tile_width, spec.tile_height, 20
        chunks = -(-spec.height // rows) * -(-spec.width // columns)
        file.seek(end + 1)
        offsets = np.frombuffer(file.read(8 * chunks), "<u8")
        first, last = sorted((int(offsets[0]), int(offsets[-1])))
        ascending, data = offsets[1:] > offsets[:-1], file.tell()
        file.seek(last + leader - 4)
        (packed,) = struct.unpack("<I", file.read(4))
        in_order = len(offsets) == chunks and (ascending.all() or not ascending.any())
        return in_order and first >= data and last + leader + packed <= file.seek(0, os.SEEK_END)
    return False


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


@contextmanager
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
