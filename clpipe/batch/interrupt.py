"""Handles Ctrl-C and SIGTERM: the first finishes images in flight, the second stops at once."""

import contextlib
import os
import signal
import sys
import threading
from collections.abc import Callable, Iterator
from types import FrameType

from clpipe.base.files import remove_temporary_files
from clpipe.outputs.folder import release_folders

SIGNALS = (signal.SIGINT, signal.SIGTERM)
INTERRUPTED = 130  # exit status


@contextlib.contextmanager
def interruptible(stop: Callable[[], None]) -> Iterator[None]:
    """Call ``stop`` at the first signal, and end the process at the second.

    The process then leaves no half-written file and no lock file. In threads other than the main
    thread, which do not receive signals, this does nothing.
    """
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    is_stopping = False

    def handle(number: int, frame: FrameType | None) -> None:
        nonlocal is_stopping
        if is_stopping:
            remove_temporary_files()
            release_folders()
            os._exit(INTERRUPTED)
        is_stopping = True
        stop()
        # No print() here, because the signal may have interrupted another print().
        with contextlib.suppress(OSError):
            os.write(sys.stderr.fileno(), b"\nfinishing images in progress; repeat to stop now\n")

    before = {number: signal.signal(number, handle) for number in SIGNALS}
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
