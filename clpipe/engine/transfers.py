"""Transfers of pixels to a device and back: without copies, or through staging buffers.

An image or a tile needs three steps: ``upload``, ``target`` for the eight-bit pixels, and ``fetch``
for each result. The array of a fetch is valid from the completion of its event until ``done``. At
most ``depth`` images or tiles may be between ``upload`` and ``done``.
"""

import weakref
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from clpipe.base.memory import release_pages
from clpipe.base.types import Array
from clpipe.engine.buffers import Pool, aligned_empty

Upload = tuple[Any, list[Any]]  # a buffer, and the events after which kernels can read it
Fetch = tuple[Array, Any]  # bytes, and the event after which they are valid


def bytes_from(array: Array, size: int) -> Array | None:
    """Return ``size`` bytes of memory, starting at the first byte of a C-contiguous array.

    The bytes may extend past the array, into the array that it is a view of. If that array ends
    earlier, return None.

    >>> room = np.arange(6, dtype=np.uint8)
    >>> bytes_from(room[1:3], 4), bytes_from(room[1:3], 6)
    (array([1, 2, 3, 4], dtype=uint8), None)
    """
    owner = array
    while isinstance(owner.base, np.ndarray):
        owner = owner.base
    if not owner.flags.c_contiguous:
        return None
    start = array.ctypes.data - owner.ctypes.data
    whole = owner.reshape(-1).view(np.uint8)
    return whole[start : start + size] if start + size <= whole.size else None


def fill(data: Array, parts: Sequence[Array], dtype: Any, stride: int) -> None:
    """Convert arrays to a type, and copy them to offsets in bytes that are ``stride`` apart."""
    for number, part in enumerate(parts):
        start, count = number * stride, part.size * np.dtype(dtype).itemsize
        target = data[start : start + count].view(dtype).reshape(part.shape)
        np.copyto(target, part, casting="unsafe")
        if type(part) is np.memmap:
            release_pages(part)


def _unmap(array: Array, queue: Any) -> None:
    """Unmap mapped memory."""
    base: Any = array.base
    base.release(queue)


class ZeroCopy:
    """Transfers for a device that uses host memory directly: kernels use NumPy's arrays.

    An array is copied first if its type, order or alignment is wrong, or if too little memory
    follows it.
    """

    depth = 1

    def __init__(self, cl: Any, queue: Any, alignment: int) -> None:
        self._cl = cl
        self._queue = queue
        self._alignment = alignment
        self._flags = cl.mem_flags.USE_HOST_PTR
        self._scratch: dict[str, Array] = {}
        self._maps: list[Array] = []
        self._io_buffers: list[Any] = []

    def needs(self, sizes: Mapping[str, int]) -> dict[str, int]:
        """Return the buffers of a tiling that must be allocated, as bytes by name."""
        return {name: size for name, size in sizes.items() if name[:3] not in ("src", "dst")}

    def upload(self, source: Array, pixels: Array, dtype: Any, size: int) -> Upload:
        """Return a buffer of ``size`` bytes that begins with an image, as samples of ``dtype``.

        ``pixels`` is a view of the array ``source``.
        """
        data = None
        if pixels.dtype == dtype and pixels.flags.c_contiguous:
            data = bytes_from(pixels, size)
        if data is None or data.ctypes.data % self._alignment:
            data = self._scratch_memory("src", size)
            fill(data, [pixels], dtype, size)
        return self._io_buffer(self._cl.mem_flags.READ_ONLY, data), []

    def upload_all(self, parts: Sequence[Array], dtype: Any, stride: int) -> Upload:
        """Return a buffer of images, ``stride`` bytes apart, as samples of ``dtype``."""
        data = self._scratch_memory("src", stride * len(parts))
        fill(data, parts, dtype, stride)
        return self._io_buffer(self._cl.mem_flags.READ_ONLY, data), []

    def reuse_upload(self, source: Array) -> Upload | None:
        """Return the last upload if it was of this array, else None.

        This class always returns None, because its uploads cost nothing.
        """
        return None

    def target(self, size: int, whole: Array | None) -> Any:
        """Return a buffer for eight-bit pixels, or None for size 0.

        The buffer uses the array ``whole`` if one is given. Call this once per image or tile.
        """
        if not size:
            return None
        data = self._scratch_memory("dst", size) if whole is None else whole
        return self._io_buffer(self._cl.mem_flags.READ_WRITE, data)

    def fetch(self, name: str, buffer: Any, size: int, after: Sequence[Any]) -> Fetch:
        """Enqueue a fetch of a buffer's first ``size`` bytes, after the events ``after``."""
        array, event = self._cl.enqueue_map_buffer(
            self._queue,
            buffer,
            self._cl.map_flags.READ,
            0,
            (size,),
            np.uint8,
            wait_for=after,
            is_blocking=False,
        )
        self._maps.append(array)
        return array, event

    def flush(self) -> None:
        """Make the device start the enqueued commands."""
        self._queue.flush()

    def done(self) -> None:
        """Release the fetched arrays. They must not be used any more."""
        maps, self._maps = self._maps, []
        buffers, self._io_buffers = self._io_buffers, []
        for array in maps:
            _unmap(array, self._queue)
        for buffer in buffers:
            buffer.release()

    def release(self) -> None:
        """Release all memory."""
        self._scratch.clear()
        self.done()

    def _scratch_memory(self, name: str, size: int) -> Array:
        """Return scratch memory, which is reused if it is large enough."""
        if name not in self._scratch or self._scratch[name].size < size:
            self._scratch[name] = aligned_empty((size,), np.uint8)
        return self._scratch[name][:size]

    def _io_buffer(self, access: int, data: Array) -> Any:
        context = self._queue.context
        self._io_buffers.append(self._cl.Buffer(context, access | self._flags, hostbuf=data))
        return self._io_buffers[-1]


class Staged:
    """Transfers for a device with separate memory: copies in both directions while kernels run.

    Two extra queues copy from and to page-locked memory; with other memory, the host would wait for
    each copy. Every buffer exists twice, and the two are used alternately.
    """

    depth = 2

    def __init__(self, cl: Any, queue: Any, new_queue: Any, pool: Pool) -> None:
        self._cl = cl
        self._queue = queue
        self._pool = pool
        self._up, self._down = new_queue(), new_queue()
        self._pinned: dict[str, tuple[Any, Array]] = {}
        self._source = self._target = 0  # which of the two buffers is in use
        self._last_upload: tuple[weakref.ref[Array], Upload] | None = None

    def needs(self, sizes: Mapping[str, int]) -> dict[str, int]:
        """See :meth:`ZeroCopy.needs`."""
        return dict(sizes)

    def upload(self, source: Array, pixels: Array, dtype: Any, size: int) -> Upload:
        """See :meth:`ZeroCopy.upload`."""
        sent = self.upload_all([pixels], dtype, pixels.size * np.dtype(dtype).itemsize)
        self._last_upload = (weakref.ref(source), sent) if pixels.size == source.size else None
        return sent

    def upload_all(self, parts: Sequence[Array], dtype: Any, stride: int) -> Upload:
        """See :meth:`ZeroCopy.upload_all`."""
        self._source, self._last_upload = 1 - self._source, None
        size = stride * len(parts)
        data = self._page_locked(f"src{self._source}", size)[:size]
        fill(data, parts, dtype, stride)
        buffer = self._pool.buffers[f"src{self._source}"]
        sent = buffer, [self._cl.enqueue_copy(self._up, buffer, data, is_blocking=False)]
        self._up.flush()
        return sent

    def reuse_upload(self, source: Array) -> Upload | None:
        """See :meth:`ZeroCopy.reuse_upload`."""
        if not self._last_upload or self._last_upload[0]() is not source:
            return None
        sent = self._last_upload[1]
        return sent if self._pool.buffers.get(f"src{self._source}") is sent[0] else None

    def target(self, size: int, whole: Array | None) -> Any:
        """See :meth:`ZeroCopy.target`."""
        self._target = 1 - self._target
        return self._pool.buffers.get(f"dst{self._target}")

    def fetch(self, name: str, buffer: Any, size: int, after: Sequence[Any]) -> Fetch:
        """See :meth:`ZeroCopy.fetch`."""
        self._queue.flush()
        array = self._page_locked(f"{name}.{self._target}", size)[:size]
        event = self._cl.enqueue_copy(
            self._down, array, buffer, wait_for=list(after), is_blocking=False
        )
        return array, event

    def flush(self) -> None:
        """See :meth:`ZeroCopy.flush`."""
        self._queue.flush()
        self._down.flush()

    def done(self) -> None:
        """See :meth:`ZeroCopy.done`."""

    def release(self) -> None:
        """See :meth:`ZeroCopy.release`."""
        self._last_upload = None
        pinned, self._pinned = self._pinned, {}
        for queue in (self._up, self._down):
            queue.finish()
        for buffer, array in pinned.values():
            _unmap(array, self._down)
            buffer.release()

    def _page_locked(self, name: str, size: int) -> Array:
        """Return page-locked memory of at least this size, which is reused for later images."""
        cl = self._cl
        existing = self._pinned.get(name)
        if existing and existing[1].size >= size:
            return existing[1]
        flags = cl.mem_flags.READ_WRITE | cl.mem_flags.ALLOC_HOST_PTR
        buffer = cl.Buffer(self._queue.context, flags, size)
        both = cl.map_flags.READ | cl.map_flags.WRITE
        array, _ = cl.enqueue_map_buffer(
            self._down, buffer, both, 0, (size,), np.uint8, is_blocking=True
        )
        if existing:
            _unmap(existing[1], self._down)
            existing[0].release()
        self._pinned[name] = buffer, array
        return array
