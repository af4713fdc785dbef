"""Times of the frames of a sequence: from time stamps in names, from tables, and from clips."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from fractions import Fraction
from itertools import pairwise
from statistics import median_low
from typing import Any

from clpipe.base.errors import RequestError

UNITS = (1, 10**3, 10**6, 10**9)  # of time stamps, per second
EARLIEST, LATEST = 5 * 10**8, 42 * 10**8  # s since 1970: from 1985 to 2103

# Frames per second of NTSC and of its multiples, which are often written with decimals.
NTSC = [Fraction(each * 1000, 1001) for each in (24, 30, 48, 60, 120)]
SAME_RATE = 2e-4  # relative; 30 and 30000/1001 differ by 1e-3


def seconds_of(stamp: Fraction) -> Fraction | None:
    """Return the time of a time stamp in s; None if a number is no time stamp.

    Time stamps are in seconds, milliseconds, microseconds or nanoseconds since 1970.

    >>> seconds_of(Fraction("1305031102.175304")) == seconds_of(Fraction(1305031102175304000))
    True
    >>> seconds_of(Fraction(1001)), seconds_of(Fraction(20231128123045))
    (None, None)
    """
    return next((stamp / unit for unit in UNITS if EARLIEST <= stamp / unit < LATEST), None)


def time_of(value: Any) -> Fraction:
    """Return the time of a column's value in s: a number of seconds, or a time stamp.

    >>> time_of(-0.5), time_of(1305031102500)
    (Fraction(-1, 2), Fraction(2610062205, 2))

    Raises:
        RequestError: it is neither.
    """
    is_number = isinstance(value, int | float | Fraction) and not isinstance(value, bool)
    if not is_number or not -math.inf < value < math.inf:
        raise RequestError(
            f"time: found {value}, but expected a number: seconds, or a time stamp in s, ms, us or "
            "ns since 1970"
        )
    time = Fraction(str(value))  # the decimals of a float, not its binary digits
    time = seconds_of(time) or time
    if abs(time) > LATEST:
        raise RequestError(f"time: found {value!r}, which is neither seconds nor a time stamp")
    return time


def decimal_text(time: Fraction) -> str:
    """Return a time in s with at most nine decimals.

    >>> decimal_text(Fraction(1, 24)), decimal_text(Fraction(-5, 2)), decimal_text(Fraction(3))
    ('0.041666667', '-2.5', '3.0')
    """
    whole, decimals = divmod(round(abs(time) * 10**9), 10**9)
    return "-" * (time < 0) + f"{whole}.{decimals:09}".rstrip("0") + "0" * (not decimals)


def standard_rate(rate: Fraction) -> Fraction:
    """Return the frame rate that a number means: one of NTSC, or a simple fraction.

    >>> standard_rate(Fraction("29.97")), standard_rate(Fraction("23.976"))
    (Fraction(30000, 1001), Fraction(24000, 1001))
    >>> standard_rate(Fraction(1, 3600))
    Fraction(1, 3600)
    """
    near = [each for each in NTSC if abs(rate / each - 1) < SAME_RATE]
    if near and rate != round(rate):
        return near[0]
    return rate.limit_denominator(1001) if rate > 1 else 1 / (1 / rate).limit_denominator(1001)


@dataclass(frozen=True)
class Timing:
    """When the frames of a sequence were taken.

    Args:
        interval: the usual time between two frames in s: the mean of intervals like the median.
        places: the place of each frame by its time, in intervals from the first frame.
    """

    interval: Fraction
    places: Mapping[Fraction, float]


def timing_of(times: Sequence[Fraction]) -> Timing:
    """Return the timing of at least two times in s, in ascending order.

    >>> [*timing_of([Fraction(each, 100) for each in (0, 4, 8, 16, 18)]).places.values()]
    [0, 1, 2, 4, 4.5]
    """
    intervals = [b - a for a, b in pairwise(times)]
    median = median_low(intervals)
    usual = [each for each in intervals if round(each / median) == 1]
    interval = sum(usual, Fraction()) / len(usual)
    places = {time: (time - times[0]) / interval for time in times}
    exact = {time: int(n) if n.denominator == 1 else float(n) for time, n in places.items()}
    return Timing(interval, exact)
