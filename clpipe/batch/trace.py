"""The timeline of a run, for Perfetto (ui.perfetto.dev) and chrome://tracing."""

import contextlib
import json
import os
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any, Self

from clpipe.base.errors import RequestError
from clpipe.base.files import atomic_file, check_suffix, create_parents
from clpipe.base.reading import read_start
from clpipe.batch.outcome import STEPS, Outcome

BEGINNING = b'{"traceEvents"'


def check_trace(path: Path) -> None:
    """Check that a trace may be written to a file.

    Raises:
        RequestError: the name does not end in .json, or the file exists and is not a trace.
    """
    check_suffix("--trace", path, ".json")
    try:
        own = read_start(path, len(BEGINNING)) == BEGINNING
    except FileNotFoundError:
        return
    except OSError:
        own = False
    if not own:
        raise RequestError(f"--trace: {path} exists and is not a trace; choose another name")


class Trace:
    """Writes what each thread did when: steps of images, launches and transfers.

    The file is in Chrome's "Trace Event Format" (complete events, in microseconds). Events go to a
    temporary file, which is renamed when the context ends, also after an error. A killed process
    leaves the temporary file, which is readable, because the format needs no end.

    Args:
        path: the file.
    """

    def __init__(self, path: Path) -> None:
        self._path = path
        self._stack = contextlib.ExitStack()
        self._threads: dict[str, int] = {}
        self._began = time.perf_counter()
        self._separator = b"\n"
        self._error: OSError | None = None

    def __enter__(self) -> Self:
        """Begin the file.

        Raises:
            ImageError: it cannot be written.
        """
        create_parents(self._path)
        self._file = self._stack.enter_context(atomic_file(self._path))
        self._file.write(BEGINNING + b": [")
        return self

    def add(self, outcome: Outcome) -> None:
        """Add the spans of one image. An error is raised when the context ends."""
        if self._error:
            return
        try:
            for event in self._events(outcome):
                self._file.write(self._separator + json.dumps(event).encode())
                self._separator = b",\n"
        except OSError as error:
            self._error = error

    def __exit__(self, *error: object) -> None:
        """End the file.

        Raises:
            ImageError: it could not be written.
        """
        with self._stack:
            if self._error:
                raise self._error
            self._file.write(b'\n], "displayTimeUnit": "ms"}\n')

    def _events(self, outcome: Outcome) -> Iterator[dict[str, Any]]:
        for span in outcome.spans:
            is_step = span.step in STEPS
            if span.worker not in self._threads:
                self._threads[span.worker] = len(self._threads) + 1
                yield {
                    "name": "thread_name",
                    "ph": "M",
                    "pid": os.getpid(),
                    "tid": self._threads[span.worker],
                    "args": {"name": span.worker},
                }
            yield {
                "name": f"{span.step} {outcome.job.stem}" if is_step else span.step,
                "cat": span.step if is_step else "launch",
                "ph": "X",
                "ts": (span.start - self._began) * 1e6,
                "dur": span.seconds * 1e6,
                "pid": os.getpid(),
                "tid": self._threads[span.worker],
                "args": {"input": str(outcome.job.path), "megapixels": outcome.megapixels},
            }
