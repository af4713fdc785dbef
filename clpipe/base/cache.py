"""Caches in memory, which drop the least recently used values, and hashes of their keys."""

import threading
from collections import OrderedDict
from collections.abc import Callable, Hashable
from typing import Any, Generic, TypeVar

T = TypeVar("T")
V = TypeVar("V")


class Identity:
    """A cache key that compares an object by identity, for objects too large to compare by value.

    The key holds a reference to the object, so that no other object can get the same ``id``.
    """

    __slots__ = ("of",)

    def __init__(self, of: object) -> None:
        self.of = of

    def __eq__(self, other: object) -> bool:
        return type(other) is Identity and other.of is self.of

    def __hash__(self) -> int:
        return id(self.of)


class BoundedCache(Generic[V]):
    """A cache that drops the least recently used values above its capacity.

    Threads may share it. A pickled copy is empty.

    Args:
        capacity: the most values that it keeps or, with ``size``, the largest sum of their sizes.
        size: returns the size of a value.

    >>> squares = BoundedCache(2)
    >>> [squares.get(n, lambda n=n: n * n) for n in (2, 3, 2, 4)], squares.used
    ([4, 9, 4, 16], 2)
    >>> [squares.get(n, lambda: 0) for n in (2, 3)], 4 in squares, len(squares)
    ([4, 0], False, 2)
    >>> texts = BoundedCache(5, size=len)
    >>> [texts.get(n, lambda n=n: n * "x") for n in (2, 3, 6)], texts.used, 6 in texts
    (['xx', 'xxx', 'xxxxxx'], 5, False)
    """

    def __init__(self, capacity: int, size: Callable[[V], int] | None = None) -> None:
        self._capacity = capacity
        self._size = size
        self._lock = threading.Lock()  # guards the values and the sum of their sizes
        self._values: OrderedDict[Hashable, Any] = OrderedDict()
        self.used = 0  # the part of the capacity in use

    def __contains__(self, key: Hashable) -> bool:
        return key in self._values

    def __len__(self) -> int:
        return len(self._values)

    def get(self, key: Hashable, make: Callable[[], V]) -> V:
        """Return the value of a key. If the cache has none, call ``make`` and keep its result.

        A value larger than the capacity is not kept. Exceptions of ``make`` are passed on.
        """
        with self._lock:
            cached = self._values.get(key, self)
            if cached is not self:
                self._values.move_to_end(key)
                found: V = cached
                return found
        value = make()
        with self._lock:
            if key not in self._values and self._size_of(value) <= self._capacity:
                self._values[key] = value
                self.used += self._size_of(value)
                while self.used > self._capacity:
                    self.used -= self._size_of(self._values.popitem(last=False)[1])
        return value

    def clear(self) -> None:
        """Forget all values."""
        with self._lock:
            self._values.clear()
            self.used = 0

    def _size_of(self, value: V) -> int:
        return self._size(value) if self._size else 1

    def __reduce__(self) -> tuple[Any, ...]:
        return BoundedCache, (self._capacity, self._size)


def cached_hash(class_: type[T]) -> type[T]:
    """Decorate a frozen dataclass, so that each object hashes its fields only once.

    A plan, for example, is looked up for each image, and hashing its contents is slow.
    """
    hash_of_fields = class_.__hash__

    def cached(self: Any) -> int:
        if "_hash" not in self.__dict__:
            self.__dict__["_hash"] = hash_of_fields(self)
        known: int = self.__dict__["_hash"]
        return known

    class_.__hash__ = cached  # type: ignore[method-assign]
    return class_
