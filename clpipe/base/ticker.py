"""Calls a function at fixed intervals."""

import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager


@contextmanager
def ticking(seconds: float, work: Callable[[], None]) -> Iterator[None]:
    """Call a function in a thread, at fixed intervals until the context ends.

    >>> called = threading.Event()
    >>> with ticking(0.01, called.set):
    ...     called.wait(60)
    True
    """
    ended = threading.Event()

    def run() -> None:
        while not ended.wait(seconds):
            work()

    thread = threading.Thread(target=run, name="ticker", daemon=True)
    thread.start()
    try:
        yield
    finally:
        ended.set()
        thread.join()
