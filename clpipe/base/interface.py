"""Whether this process runs a command, whose messages name options of the command line."""

from collections.abc import Iterator
from contextlib import contextmanager

_running = 0  # commands; tests call them in one process


@contextmanager
def command_line() -> Iterator[None]:
    """Mark the ``with`` block as a command, in every thread."""
    global _running  # noqa: PLW0603 - a process has one command line
    _running += 1
    try:
        yield
    finally:
        _running -= 1


def on_command_line() -> bool:
    """Return whether a command is running.

    >>> with command_line():
    ...     on_command_line()
    True
    """
    return _running > 0
