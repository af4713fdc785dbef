"""A record of the contents of a device's buffers, so that unchanged launches are skipped.

The kernel, the argument values and the contents of its input buffers determine the output of a
launch. A digest of these represents the output. The source is no output of a kernel, so a number
represents it. Comparing digests is therefore enough, and a change affects exactly the launches that
depend on it.
"""

import weakref
from collections.abc import Sequence
from dataclasses import dataclass, field
from hashlib import blake2b
from typing import Any

import numpy as np
from xxhash import xxh3_128_digest

from clpipe.base.types import Array
from clpipe.engine.bindings import Bind
from clpipe.engine.buffers import Pool
from clpipe.engine.extents import Extents
from clpipe.engine.stack import Call


def digest_of(*parts: bytes) -> bytes:
    """Return a digest of bytes, 16 bytes long."""
    return blake2b(b"".join(parts), digest_size=16).digest()


@dataclass(frozen=True)
class LaunchCache:
    """The contents of buffers after an image that was processed whole. Initially it is empty.

    Args:
        source: the image's array.
        number: the number of sources so far, which distinguishes them.
        buffers: for each name, the buffer itself, because another may replace it, and the digest
            that represents its contents.
    """

    source: weakref.ref[Array] | None = None
    number: int = 0
    buffers: dict[str, tuple[Any, bytes]] = field(default_factory=dict)

    def next(
        self,
        calls: Sequence[Call],
        pool: Pool,
        source: Array,
        unchanged: bool,
        extents: Extents,
        bind: Bind,
    ) -> tuple[tuple[int, ...], "LaunchCache"]:
        """Return the launches that the next image needs, and the contents of buffers after them.

        Args:
            calls: the calls of a plan whose launches write each buffer once.
            pool: the buffers.
            source: the image.
            unchanged: whether the array has the same pixels, if it is that of the image before.
            extents: the image's extents on each level.
            bind: returns the values of a call.

        Returns:
            The numbers of the calls to launch, and the new cache. The last call is always launched,
            because its results need not stay on the device.
        """
        is_same_source = unchanged and self.source is not None and self.source() is source
        number = self.number + (not is_same_source)
        updated = LaunchCache(weakref.ref(source), number, dict(self.buffers))
        planes = [repr(extent.numbers).encode() for extent in extents]

        def is_current(name: str, output_digest: bytes) -> bool:
            buffer, digest_held = updated.buffers.get(name, (None, b""))
            return buffer is pool.buffers[name] and digest_held == output_digest

        def digest(value: Any) -> bytes:
            return (
                xxh3_128_digest(value.data)
                if isinstance(value, np.ndarray)
                else repr(value).encode()
            )

        numbers = []
        for i, call in enumerate(calls):
            level = call.kernel.launch.level
            output_digest = digest_of(
                call.kernel.name.encode(),
                planes[level],
                planes[max(level - 1, 0)],
                number.to_bytes(8) if call.reads_source else b"",
                *(updated.buffers[name][1] for name in call.reads),
                *map(digest, bind(call.values)),
            )
            if call is calls[-1] or not all(
                is_current(name, output_digest) for name in call.writes
            ):
                numbers.append(i)
            updated.buffers.update(
                (name, (pool.buffers[name], output_digest)) for name in call.writes
            )
        return tuple(numbers), updated
