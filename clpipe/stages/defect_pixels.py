"""Hot and dead pixels."""

from collections.abc import Mapping
from typing import ClassVar

import numpy as np

from clpipe.base.types import Floats
from clpipe.reference.math import negative_log
from clpipe.reference.random import word_at
from clpipe.stage import Argument, Context, Frame, Kind, Method, NoiseScope, Pass, Stage, parameter

WORDS = 1 << 31  # as many random words tell pixels apart
VISIBLE = 0.1  # signal of a hot pixel where the camera does not say its charge


class Random(Method):
    """Pixels here and there, the same in every image of a camera.

    A hot one has an extra charge of hot_level * (1 + e), e exponential of mean 1, at every ISO the
    same number of electrons; a dead one gives no signal.

    >>> from clpipe.stage import run_reference
    >>> image = np.full((300, 300), 0.1, np.float32)
    >>> image = run_reference(Random(hot_share=0.01, hot_level=0.5, dead_share=0.02), image)
    >>> round(float((image >= 0.6).mean()), 2), round(float((image == 0).mean()), 2)
    (0.01, 0.02)
    """

    method: ClassVar = "random"
    kernel: ClassVar = "defect_pixels"
    summary: ClassVar = "make some pixels of a camera hot or dead"
    example: ClassVar = {"hot_share": 0.05, "hot_level": 0.3, "dead_share": 0.05}

    hot_share: float | None = parameter(
        None, "Hot pixels, as a share of all.", "", "from the camera", ge=0, le=0.1
    )
    hot_level: float | None = parameter(
        None,
        "The least that a hot pixel adds.",
        "signal",
        "from the camera and ISO; else 0.1",
        ge=0,
    )
    dead_share: float | None = parameter(
        None, "Dead pixels, as a share of all.", "", "from the camera", ge=0, le=0.1
    )

    def resolve(self, context: Context) -> "Random":
        camera = context.camera
        return self.filled(
            hot_share=camera.hot_pixel_share,
            hot_level=camera.signal_of(camera.hot_pixel_level, context.iso) or VISIBLE,
            dead_share=camera.dead_pixel_share,
        )

    def passes(self) -> tuple[Pass, ...]:
        if not self.hot_share and not self.dead_share:
            return ()
        names = ("hot_limit", "dead_limit", "hot_scale", "hot_level")
        return (Pass("defect_pixels", arguments=names, random=NoiseScope.CAMERA),)

    def _limits(self) -> tuple[int, int]:
        assert self.hot_share is not None and self.dead_share is not None
        return round(self.hot_share * WORDS), WORDS - 1 - round(self.dead_share * WORDS)

    def arguments(self, context: Context) -> Mapping[str, Argument]:
        hot_limit, dead_limit = self._limits()
        return {
            "hot_limit": np.int32(hot_limit),
            "dead_limit": np.int32(dead_limit),
            "hot_scale": np.float32(1 / max(hot_limit, 1)),
            "hot_level": np.float32(self.hot_level),
        }

    def variance(self, before: Floats, signal: Floats, context: Context) -> Floats:
        """A few pixels that are wrong are no noise of all the others: they are left out."""
        return before

    def reference(self, image: Floats, frame: Frame) -> Floats:
        hot_limit, dead_limit = self._limits()
        words = word_at(image.shape, 0, frame.stream[NoiseScope.CAMERA])
        bits = (words >> np.uint32(1)).view(np.int32)
        u = (bits.astype(np.float32) + np.float32(0.5)) * np.float32(1 / max(hot_limit, 1))
        excess = np.maximum(negative_log(u), np.float32(0))
        hot = image + np.float32(self.hot_level) * (np.float32(1) + excess)
        alive = np.where(bits < hot_limit, hot, image)
        return np.where(bits > dead_limit, np.float32(0), alive)


STAGE = Stage("defect_pixels", "Make some pixels hot or dead.", Kind.MOSAIC, Kind.MOSAIC, (Random,))
