"""Defect pixels: hot ones with too much charge, and dead ones without signal."""

from typing import ClassVar

import numpy as np

from clpipe.base.types import Floats
from clpipe.reference.random import Stream, exponential_of
from clpipe.stage import (
    Arguments,
    Backend,
    Context,
    NoiseScope,
    Numbers,
    Pass,
    Signal,
    SignalMethod,
    camera_parameter,
    sensor_bits,
    sensor_stage,
)

RANDOM_WORDS = 1 << 31  # number of different random words that choose the pixels
# Signal units; used if the camera has no value, and chosen so that defects are visible.
DEFAULT_LEVEL = 0.1


class Random(SignalMethod):
    """Hot and dead pixels at random places, the same in every image of a camera.

    A hot pixel becomes y + hot_level * (1 + e), with e from an exponential distribution of mean 1.
    The camera's level is the same at every ISO in electrons. A dead pixel becomes 0. Levels are in
    signal units.

    >>> from clpipe.stage import run_reference
    >>> image = np.full((300, 300), 0.1, np.float32)
    >>> image = run_reference(Random(hot_share=0.01, hot_level=0.5, dead_share=0.02), image)
    >>> round(float((image >= 0.6).mean()), 2), round(float((image == 0).mean()), 2)
    (0.01, 0.02)
    """

    method: ClassVar = "random"
    kernel: ClassVar = "defect_pixels"
    summary: ClassVar = "make pixels at random positions of the sensor hot or dead"
    example: ClassVar = {"hot_share": 0.05, "hot_level": 0.3, "dead_share": 0.05}

    hot_share: float | None = camera_parameter("Share of the pixels that are hot.", ge=0, le=0.1)
    hot_level: float | None = camera_parameter(
        "Smallest extra signal of a hot pixel; the mean is twice as large.",
        "signal",
        more=" and ISO; else 0.1",
        ge=0,
    )
    dead_share: float | None = camera_parameter("Share of the pixels that are dead.", ge=0, le=0.1)

    def resolve(self, context: Context) -> "Random":
        camera = context.camera
        return self.with_defaults(
            hot_share=camera.hot_pixel_share,
            hot_level=camera.signal_of(camera.hot_pixel_level, context.iso) or DEFAULT_LEVEL,
            dead_share=camera.dead_pixel_share,
        )

    def passes(self) -> tuple[Pass, ...]:
        if not self.hot_share and not self.dead_share:
            return ()
        names = ("hot_limit", "dead_limit", "hot_scale", "hot_level")
        return (Pass("defect_pixels", arguments=names, random=NoiseScope.CAMERA),)

    def limits(self) -> tuple[int, int]:
        """Return the words below which a pixel is hot, and above which it is dead."""
        assert self.hot_share is not None and self.dead_share is not None
        return round(self.hot_share * RANDOM_WORDS), RANDOM_WORDS - 1 - round(
            self.dead_share * RANDOM_WORDS
        )

    def arguments(self, context: Context) -> Arguments:
        hot_limit, dead_limit = self.limits()
        return {
            "hot_limit": hot_limit,
            "dead_limit": dead_limit,
            "hot_scale": 1 / max(hot_limit, 1),
            "hot_level": self.hot_level,
        }

    def variance(self, input_variance: Floats, signal: Floats, context: Context) -> Floats:
        """The variance without defect pixels, which are few and not part of the noise model."""
        return input_variance

    @classmethod
    def apply(cls, y: Signal, n: Numbers, backend: Backend) -> Signal:
        hot = backend.fixed(hot_charge, lambda method, _: method.limits()[:1]) * n["hot_level"]
        alive = backend.fixed(alive_pixels, lambda method, _: method.limits()[1:])
        return backend.where(alive > 0, y + hot, 0.0)


def hot_charge(height: int, width: int, stream: Stream, limit: int) -> Floats:
    """Return the charge of hot pixels over the smallest, and 0 elsewhere."""
    bits = sensor_bits(height, width, stream)
    return np.where(bits < limit, np.float32(1) + exponential_of(bits, limit), np.float32(0))


def alive_pixels(height: int, width: int, stream: Stream, limit: int) -> Floats:
    """Return 1 for pixels that work, and 0 for dead ones."""
    return (sensor_bits(height, width, stream) <= limit).astype(np.float32)


STAGE = sensor_stage("defect_pixels", "Make some pixels hot or dead.", (Random,))
