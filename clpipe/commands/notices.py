"""Prints the package's log on the terminal, such as "compiling kernels"."""

import logging
from collections.abc import Callable, Iterator
from contextlib import contextmanager

import click

from clpipe.base.text import one_line


class Notices(logging.Handler):
    """A log handler that prints each line on stderr, or above a live display."""

    def __init__(self) -> None:
        super().__init__()
        self._printers: list[Callable[[str], None]] = []

    def emit(self, record: logging.LogRecord) -> None:
        text = f"clpipe: {one_line(record.getMessage())}"
        if self._printers:
            self._printers[-1](text)
        else:
            click.echo(text, err=True)

    @contextmanager
    def printed_by(self, printer: Callable[[str], None]) -> Iterator[None]:
        """Inside the context, print lines with a function that keeps a live display below them."""
        self._printers.append(printer)
        try:
            yield
        finally:
            self._printers.remove(printer)


NOTICES = Notices()
