"""Interleaved timing, so that other load on the machine slows all candidates down alike."""

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

Work = Callable[[], object]


def interleaved(
    works: Mapping[str, Work], repeat: int, before: Work = int
) -> dict[str, list[float]]:
    """Time each work once per round, in s. ``before`` runs before each work and is not timed."""
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
    """The times of one work by clpipe and by other programs.

    Args:
        work: a description.
        megapixels: processed in a round.
        ours, theirs: seconds of each round; theirs by name.
    """

    work: str
    megapixels: float
    ours: Sequence[float]
    theirs: Mapping[str, Sequence[float]]

    def speed(self, seconds: Sequence[float]) -> float:
        """Return the median speed, MP/s."""
        return self.megapixels / float(np.median(seconds))

    def ratios(self, name: str) -> tuple[float, float, float]:
        """Return the speed-up of clpipe over the rounds: lower quartile, median, upper quartile."""
        ratios = np.asarray(self.theirs[name]) / np.asarray(self.ours)
        low, median, high = np.percentile(ratios, (25, 50, 75))
        return float(low), float(median), float(high)

    def cells(self) -> list[str]:
        """Return a table row: the work, clpipe's speed, and each other's speed and ratios."""
        cells = [self.work, format_speed(self.speed(self.ours))]
        for name, seconds in self.theirs.items():
            low, median, high = self.ratios(name)
            cells += [format_speed(self.speed(seconds)), f"{median:.2f}", f"{low:.2f} {high:.2f}"]
        return cells


def format_speed(speed: float) -> str:
    """Format a speed in MP/s with three digits.

    >>> format_speed(0.0765), format_speed(23.45), format_speed(1234.5)
    ('0.0765', '23.4', '1234')
    """
    return f"{speed:.0f}" if speed >= 100 else f"{speed:.3g}"
