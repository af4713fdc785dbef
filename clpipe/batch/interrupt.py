"""Ctrl-C and a scheduler's SIGTERM: once to finish what is begun, twice to stop now."""

import contextlib
import os
import signal
import sys
import threading
from collections.abc import Callable, Iterator
from types import FrameType

from clpipe.base.files import remove_temporary_files

SIGNALS = (signal.SIGINT, signal.SIGTERM)


INTERRUPTED = 130


@contextlib.contextmanager
def interruptible(stop: Callable[[], None]) -> Iterator[None]:
    """Call ``stop`` at the first signal; at the second end the process, leaving no half file.

    Signals only come to the main thread; in another one this does nothing.
    """
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    asked = False

    def handle(number: int, frame: FrameType | None) -> None:
        nonlocal asked
        if asked:
            remove_temporary_files()
            os._exit(INTERRUPTED)
        asked = True
        stop()
        # Not print: the signal may have come in the midst of one.
        os.write(sys.stderr.fileno(), b"\nfinishing what is begun; again to stop now\n")

    before = {number: signal.signal(number, handle) for number in SIGNALS}
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
