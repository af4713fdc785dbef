"""The signal-to-noise ratio by intensity, over as many stops as there are."""

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from clpipe.analysis.measure import against
from clpipe.analysis.pictures import Picture

PER_STOP = 2  # steps of intensity
FEWEST = 400  # samples of a step; the standard error of its ratio is then .3 dB
STOPS = 24  # below the brightest, that are looked at


@dataclass(frozen=True)
class SnrStep:
    """The signal-to-noise ratio at an intensity.

    Args:
        intensity: the mean, in the unit of the images.
        stops: how many it is below the brightest step.
        decibels: 20 log10 of mean over standard deviation, as EMVA 1288 has it.
        samples: of which there are.
    """

    intensity: float
    stops: float
    decibels: float
    samples: int


def snr_curve(images: Sequence[Picture], truth: Picture | None = None) -> list[SnrStep]:
    """The signal-to-noise ratio in steps of half a stop, from the darkest to the brightest.

    Noise is the difference from the truth, or from the mean of the images, as for
    :func:`clpipe.analysis.measure.measure`; clipped samples are left out.

    Raises:
        RequestError, ImageError: as there.
    """
    clean, _, noise, clipped = against(images, truth)
    counts = (clean > 0) & ~np.any(clipped, axis=0)
    if truth:
        counts &= ~truth.clipped()
    light = clean[counts].astype(np.float64)
    if not light.size:
        return []
    brightest = float(light.max())
    steps = np.floor(-np.log2(light / brightest) * PER_STOP).astype(np.int64)
    curve = []
    for step in range(STOPS * PER_STOP, -1, -1):
        own = steps == step
        if int(own.sum()) * len(noise) < FEWEST:
            continue
        mean = float(light[own].mean())
        # About its mean: a difference of tone is no noise.
        sigma = float(noise[:, counts][:, own].std(dtype=np.float64))
        ratio = 20 * np.log10(mean / sigma) if sigma else np.inf
        stops = float(np.log2(brightest / mean))
        curve.append(SnrStep(mean, stops, float(ratio), int(own.sum()) * len(noise)))
    return curve


def record_of(curve: Sequence[SnrStep]) -> list[dict[str, Any]]:
    """A curve as JSON values."""
    return [asdict(step) for step in curve]
