"""Caches in memory: values by their keys, of which those are kept that were used last."""

import threading
from collections import OrderedDict
from collections.abc import Callable, Hashable
from typing import Any, Generic, TypeVar

V = TypeVar("V")


class Identity:
    """An object as a key that is equal to no other's, for what is too large to be compared.

    It keeps the object, so that no other can come to lie in its place.
    """

    __slots__ = ("of",)

    def __init__(self, of: object) -> None:
        self.of = of

    def __eq__(self, other: object) -> bool:
        return type(other) is Identity and other.of is self.of

    def __hash__(self) -> int:
        return id(self.of)


class BoundedCache(Generic[V]):
    """Values by their keys, of which those go first that were not used for longest.

    Threads may share it. In another process it begins empty.

    Args:
        bound: how much all values may take together: how many they are, or where there is a
            ``size``, the sum of their sizes.
        size: how much one takes.

    >>> squares = BoundedCache(2)
    >>> [squares.get(n, lambda n=n: n * n) for n in (2, 3, 2, 4)], squares.taken
    ([4, 9, 4, 16], 2)
    >>> [squares.get(n, lambda: 0) for n in (2, 3)], 4 in squares, len(squares)
    ([4, 0], False, 2)
    >>> texts = BoundedCache(5, size=len)
    >>> [texts.get(n, lambda n=n: n * "x") for n in (2, 3, 6)], texts.taken, 6 in texts
    (['xx', 'xxx', 'xxxxxx'], 5, False)
    """

    def __init__(self, bound: int, size: Callable[[V], int] | None = None) -> None:
        self._bound = bound
        self._size = size
        self._lock = threading.Lock()  # guards the values and the sum of their sizes
        self._values: OrderedDict[Hashable, Any] = OrderedDict()
        self.taken = 0  # of the bound

    def __contains__(self, key: Hashable) -> bool:
        return key in self._values

    def __len__(self) -> int:
        return len(self._values)

    def get(self, key: Hashable, make: Callable[[], V]) -> V:
        """The value of a key: the one that is kept, else what ``make`` gives, which is then kept.

        A value that is larger than the bound is not kept. What ``make`` raises is passed on.
        """
        with self._lock:
            known = self._values.get(key, self)
            if known is not self:
                self._values.move_to_end(key)
                found: V = known
                return found
        value = make()
        with self._lock:
            if key not in self._values and self._size_of(value) <= self._bound:
                self._values[key] = value
                self.taken += self._size_of(value)
                while self.taken > self._bound:
                    self.taken -= self._size_of(self._values.popitem(last=False)[1])
        return value

    def clear(self) -> None:
        """Forget all values."""
        with self._lock:
            self._values.clear()
            self.taken = 0

    def _size_of(self, value: V) -> int:
        return self._size(value) if self._size else 1

    def __reduce__(self) -> tuple[Any, ...]:
        return BoundedCache, (self._bound, self._size)
