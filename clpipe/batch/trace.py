"""A run as a trace, for Perfetto (ui.perfetto.dev) and chrome://tracing."""

import json
import os
from pathlib import Path
from typing import Any

from clpipe.base.errors import RequestError
from clpipe.base.files import write_new
from clpipe.base.reading import check_regular
from clpipe.batch.outcome import STEPS, Outcome

BEGINNING = b'{"traceEvents"'


def check_trace(path: Path) -> None:
    """See that a trace may be written to a file.

    Raises:
        RequestError: the name does not end in .json, or the file exists and is no trace.
    """
    if path.suffix != ".json":
        raise RequestError(f"--trace: found {path}; expected a name that ends in .json")
    try:
        check_regular(path)
        with open(path, "rb") as file:
            own = file.read(len(BEGINNING)) == BEGINNING
    except FileNotFoundError:
        return
    except OSError:
        own = False
    if not own:
        raise RequestError(f"--trace: {path} exists and is no trace; choose another name")


class Trace:
    """What each thread did when: the steps of each image, each launch and each transfer.

    The file is in Chrome's "Trace Event Format" (complete events, in microseconds).
    """

    def __init__(self) -> None:
        self._events: list[dict[str, Any]] = []
        self._threads: dict[str, int] = {}

    def add(self, outcome: Outcome) -> None:
        """Add the spans of one image."""
        for span in outcome.spans:
            is_step = span.step in STEPS
            number = self._threads.setdefault(span.worker, len(self._threads) + 1)
            event = {
                "name": f"{span.step} {outcome.job.stem}" if is_step else span.step,
                "cat": span.step if is_step else "launch",
                "ph": "X",
                "ts": span.start * 1e6,
                "dur": span.seconds * 1e6,
                "pid": os.getpid(),
                "tid": number,
                "args": {"input": str(outcome.job.path), "megapixels": outcome.megapixels},
            }
            self._events.append(event)

    def write(self, path: Path) -> None:
        """Write the trace.

        Raises:
            ImageError: it cannot be written.
        """
        first = min((event["ts"] for event in self._events), default=0.0)
        events = [{**event, "ts": event["ts"] - first} for event in self._events]
        names: list[dict[str, Any]] = [
            {
                "name": "thread_name",
                "ph": "M",
                "pid": os.getpid(),
                "tid": number,
                "args": {"name": worker},
            }
            for worker, number in self._threads.items()
        ]
        text = json.dumps({"traceEvents": [*names, *events], "displayTimeUnit": "ms"})
        write_new(path, lambda to: to.write_text(text, "utf-8"))
