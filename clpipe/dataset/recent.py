"""What was used last, kept in memory while it fits."""

import threading
from collections import OrderedDict
from collections.abc import Callable, Hashable
from typing import Any, Generic, TypeVar

V = TypeVar("V")


def one(_value: object) -> int:
    """The size of a value where values are counted."""
    return 1


class Recent(Generic[V]):
    """Values by their keys, of which those go first that were not used for longest.

    Threads may share it. In another process it begins empty.

    Args:
        room: how much all values may take together.
        size: how much one takes.

    >>> squares = Recent(2)
    >>> [squares.get(n, lambda n=n: n * n) for n in (2, 3, 2, 4)], squares.taken
    ([4, 9, 4, 16], 2)
    >>> [squares.get(n, lambda: 0) for n in (2, 3)]
    [4, 0]
    """

    def __init__(self, room: int, size: Callable[[V], int] = one) -> None:
        self._room = room
        self._size = size
        self._lock = threading.Lock()
        self._held: OrderedDict[Hashable, V] = OrderedDict()
        self.taken = 0  # of the room

    def get(self, key: Hashable, make: Callable[[], V]) -> V:
        """The value of a key, as it is held, else as ``make`` gives it."""
        with self._lock:
            if key in self._held:
                self._held.move_to_end(key)
                return self._held[key]
        value = make()
        with self._lock:
            if key not in self._held and self._size(value) <= self._room:
                self._held[key] = value
                self.taken += self._size(value)
                while self.taken > self._room:
                    self.taken -= self._size(self._held.popitem(last=False)[1])
        return value

    def __reduce__(self) -> tuple[Any, ...]:
        return Recent, (self._room, self._size)
