"""TODO."""

import threading
import time
from collections import deque
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Any

from clpipe.base.types import Array
from clpipe.batch.outcome import DONE, FAILED, Outcome, Span
from clpipe.engine.device import Device
from clpipe.engine.runner import Result
from clpipe.images.read import SourceImage
from clpipe.inputs.find import Job
from clpipe.inputs.loader import ImageLoader
from clpipe.outputs.renditions import Rendition


@dataclass
class Work:
    """A job on its way."""

    job: Job
    entrance: ImageLoader
    began: float = field(default_factory=time.time)
    spans: list[Span] = field(default_factory=list)
    source: SourceImage | None = None
    stamp: tuple[int, int] = (0, 0)
    wanted: Mapping[str, Any] = field(default_factory=dict)
    shots: list[Rendition] = field(default_factory=list)
    unwritten: int = 0
    status: str = DONE
    error: str = ""
    outputs: list[str] = field(default_factory=list)

    @contextmanager
    def timed(self, step: str) -> Iterator[None]:
        """Note when a step was done, and by which thread."""
        start = time.perf_counter()
        try:
            yield
        finally:
            name = threading.current_thread().name
            self.spans.append(Span(step, name, start, time.perf_counter() - start))

    def outcome(self) -> Outcome:
        """What became of it."""
        width, height = self.source.pixels.shape[1::-1] if self.source else (0, 0)
        return Outcome(
            self.job,
            FAILED if self.error else self.status,
            width * height / 1e6,
            self.source.warnings if self.source else (),
            self.error,
            tuple(self.outputs),
            self.began,
            tuple(self.spans),
        )


# A picture on its way from a device to its files.
Made = tuple[Work, Rendition, Result, Device | None]


class _Spare:
    """Arrays that are not used any more, to be used again: new memory costs time.

    >>> spare = _Spare(2)
    >>> spare.give(np.zeros((2, 3)))
    >>> spare.take((3, 2)) is None, spare.take((2, 3)).shape, spare.take((2, 3)) is None
    (True, (2, 3), True)
    """

    def __init__(self, count: int) -> None:
        self._arrays: deque[Array] = deque(maxlen=count)
        self._lock = threading.Lock()

    def take(self, shape: tuple[int, ...]) -> Array | None:
        """One of that shape; None where there is none."""
        with self._lock:
            for place, array in enumerate(self._arrays):
                if array.shape == shape:
                    del self._arrays[place]
                    return array
        return None

    def give(self, array: Array) -> None:
        """One that may be used again; the oldest is dropped where there are too many."""
        with self._lock:
            self._arrays.append(array)
