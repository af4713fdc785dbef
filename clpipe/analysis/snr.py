"""The signal-to-noise ratio by intensity, over all stops of the images."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from clpipe.analysis.measure import NoiseOf
from clpipe.analysis.pictures import Picture

PER_STOP = 2  # steps per stop of intensity
MIN_SAMPLES = 400  # samples in a step, for which the standard error of the ratio is 0.3 dB
STOPS = 24  # stops between the lowest step and the brightest one


@dataclass(frozen=True)
class SnrStep:
    """The signal-to-noise ratio at an intensity.

    Args:
        intensity: the mean, in the unit of the images.
        stops: stops below the brightest step.
        decibels: 20 log10 of mean over standard deviation, like in EMVA 1288.
        samples: the number of samples.
    """

    intensity: float
    stops: float
    decibels: float
    samples: int


def snr_curve(images: Sequence[Picture], truth: Picture | None = None) -> list[SnrStep]:
    """Return the signal-to-noise ratio in steps of half a stop, from the darkest to the brightest.

    Noise is the difference from the truth, or from the mean of the images, see
    :func:`clpipe.analysis.measure.measure`. Clipped samples are excluded.

    Raises:
        RequestError, ImageError: as there.
    """
    measured = NoiseOf.images(images, truth)
    counts = (measured.clean > 0) & measured.start & ~np.any(measured.clipped, axis=0)
    light = measured.clean[counts].astype(np.float64)
    if not light.size:
        return []
    brightest = float(light.max())
    steps = np.floor(-np.log2(light / brightest) * PER_STOP).astype(np.int64)
    curve = []
    for step in range(STOPS * PER_STOP, -1, -1):
        own = steps == step
        samples = int(own.sum()) * len(measured.noise)
        if samples < MIN_SAMPLES:
            continue
        mean = float(light[own].mean())
        # The mean is subtracted, because a difference of tone is not noise.
        sigma = float(measured.noise[:, counts][:, own].std(dtype=np.float64))
        ratio = 20 * np.log10(mean / sigma) if sigma else np.inf
        stops = float(np.log2(brightest / mean))
        curve.append(SnrStep(mean, stops, float(ratio), samples))
    return curve
