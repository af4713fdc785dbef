"""The contents of a device's buffers, so that a launch is left out that would write the same again.

What a launch writes follows from its kernel, the values of its arguments and what the buffers that
it reads hold. A digest of these stands for it, and the source, which kernels do not make, has a
number. So nothing is compared but digests, and a change reaches all that depends on it and no more.
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
    """A digest of bytes, 16 bytes long."""
    return blake2b(b"".join(parts), digest_size=16).digest()


@dataclass(frozen=True)
class LaunchCache:
    """The contents of buffers after an image that went through whole; at first nothing is known.

    Args:
        source: that image's array.
        number: how many sources there were, so that each differs from those before.
        buffers: for each buffer by name, the buffer itself, since another may take its place, and
            the digest of what made its content.
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
        """The launches to do for the next image, and the contents of buffers after them.

        Args:
            calls: of a plan whose launches write each buffer once.
            pool: the buffers.
            source: the image.
            unchanged: whether it has the same pixels still, if it is the array of the image before.
            extents: the image on each level.
            bind: gives the values of a call.

        Returns:
            The numbers of the calls to launch: those whose results are not in their buffers, and
            the last one, whose results need not stay on the device.
        """
        same = unchanged and self.source is not None and self.source() is source
        number = self.number + (not same)
        after = LaunchCache(weakref.ref(source), number, dict(self.buffers))
        planes = [repr(extent.numbers).encode() for extent in extents]

        def holds(name: str, made: bytes) -> bool:
            buffer, maker = after.buffers.get(name, (None, b""))
            return buffer is pool.buffers[name] and maker == made

        def digest(value: Any) -> bytes:
            return (
                xxh3_128_digest(value.data)
                if isinstance(value, np.ndarray)
                else repr(value).encode()
            )

        numbers = []
        for i, call in enumerate(calls):
            level = call.kernel.launch.level
            made = digest_of(
                call.kernel.name.encode(),
                planes[level],
                planes[max(level - 1, 0)],
                number.to_bytes(8) if call.reads_source else b"",
                *(after.buffers[name][1] for name in call.reads),
                *map(digest, bind(call.values)),
            )
            if call is calls[-1] or not all(holds(name, made) for name in call.writes):
                numbers.append(i)
            after.buffers.update((name, (pool.buffers[name], made)) for name in call.writes)
        return tuple(numbers), after
