"""Timing in turns: what runs at the same time on a machine then slows down all alike."""

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

Work = Callable[[], object]


def in_turns(works: Mapping[str, Work], repeat: int, before: Work = int) -> dict[str, list[float]]:
    """How long each work takes, in s, in each of so many turns; ``before`` is not counted."""
    seconds: dict[str, list[float]] = {name: [] for name in works}
    for _ in range(repeat):
        for name, work in works.items():
            before()
            start = time.perf_counter()
            work()
            seconds[name].append(time.perf_counter() - start)
    return seconds


@dataclass(frozen=True)
class Comparison:
    """One work done by clpipe and by others, in turns.

    Args:
        work: what was done.
        megapixels: in a turn.
        ours, theirs: seconds of each turn; theirs by name.
    """

    work: str
    megapixels: float
    ours: Sequence[float]
    theirs: Mapping[str, Sequence[float]]

    def speed(self, seconds: Sequence[float]) -> float:
        """The median speed, MP/s."""
        return self.megapixels / float(np.median(seconds))

    def ratios(self, name: str) -> tuple[float, float, float]:
        """How many times faster clpipe is: the quartiles of the turns, the median second."""
        ratios = np.asarray(self.theirs[name]) / np.asarray(self.ours)
        low, median, high = np.percentile(ratios, (25, 50, 75))
        return float(low), float(median), float(high)

    def cells(self) -> list[str]:
        """A table's row: the work, clpipe's speed, and of each other its speed and ratios."""
        cells = [self.work, format_speed(self.speed(self.ours))]
        for name, seconds in self.theirs.items():
            low, median, high = self.ratios(name)
            cells += [format_speed(self.speed(seconds)), f"{median:.2f}", f"{low:.2f} {high:.2f}"]
        return cells

    def record(self) -> dict[str, Any]:
        """The comparison as JSON values."""
        others = {
            name: {"mp_per_s": self.speed(seconds), "ratio_quartiles": self.ratios(name)}
            for name, seconds in self.theirs.items()
        }
        return {"work": self.work, "clpipe": {"mp_per_s": self.speed(self.ours)}, **others}


def format_speed(speed: float) -> str:
    """A speed in MP/s, to three digits.

    >>> format_speed(0.0765), format_speed(23.45), format_speed(1234.5)
    ('0.0765', '23.4', '1234')
    """
    return f"{speed:.0f}" if speed >= 100 else f"{speed:.3g}"
