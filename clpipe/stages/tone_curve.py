"""The tone curve."""

from collections.abc import Mapping
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from clpipe.reference.curve import curve_index, tabulate
from clpipe.stage import Access, Argument, Context, Frame, Kind, Method, Pass, Stage
from clpipe.types import Floats

# The DNG SDK's default curve of Adobe Camera Raw, the paper's reference [15]: knots (x, y).
KNOTS = np.array(
    [
        (0, 0),
        (0.01, 0.0083),
        (0.02, 0.0210),
        (0.05, 0.0771),
        (0.1, 0.1949),
        (0.2, 0.4294),
        (0.3, 0.5972),
        (0.4, 0.7168),
        (0.5, 0.8049),
        (0.6, 0.8708),
        (0.7, 0.9202),
        (0.8, 0.9566),
        (0.9, 0.9827),
        (1, 1),
    ]
)


def monotone_cubic(knots: NDArray[np.float64], x: NDArray[np.float64]) -> NDArray[np.float64]:
    """The monotone cubic through (n, 2) knots (Fritsch and Butland, SIAM J. Sci. Stat. 1984).

    Slopes inside are the harmonic means of the two chords beside, at the ends those of the chords.

    >>> monotone_cubic(np.array([(0, 0), (1, 1), (2, 1)]), np.array([0.0, 1.0, 1.5])).tolist()
    [0.0, 1.0, 1.0]
    """
    at, value = knots.T
    step, chord = np.diff(at), np.diff(value) / np.diff(at)
    left, right = chord[:-1], chord[1:]
    rising = left * right > 0
    mean = 2 * left * right / np.where(rising, left + right, 1)
    slope = np.concatenate([chord[:1], np.where(rising, mean, 0), chord[-1:]])
    i = np.clip(np.searchsorted(at, x, side="right") - 1, 0, len(step) - 1)
    t, h = (x - at[i]) / step[i], step[i]
    return np.asarray(
        value[i] * (1 + 2 * t) * (1 - t) ** 2
        + h * slope[i] * t * (1 - t) ** 2
        + value[i + 1] * t**2 * (3 - 2 * t)
        + h * slope[i + 1] * t**2 * (t - 1)
    )


TABLE = tabulate(lambda x: monotone_cubic(KNOTS, x))


class Default(Method):
    """The default curve of Adobe Camera Raw, on each channel of linear RGB, 0..1."""

    method: ClassVar = "default"
    kernel: ClassVar = "curve"
    summary: ClassVar = "the default curve of Adobe Camera Raw (DNG SDK)"

    def passes(self) -> tuple[Pass, ...]:
        return (Pass("curve", Access.CURVE, ("table",)),)

    def arguments(self, context: Context) -> Mapping[str, Argument]:
        return {"table": TABLE}

    def reference(self, image: Floats, frame: Frame) -> Floats:
        return TABLE[curve_index(image)]


STAGE = Stage("tone_curve", "Contrast, as a photograph has it.", Kind.RGB, Kind.RGB, (Default,))
