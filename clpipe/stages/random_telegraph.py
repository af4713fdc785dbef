"""Random telegraph noise: pixels whose read noise has two levels."""

from typing import ClassVar

import numpy as np

from clpipe.base.types import Floats
from clpipe.reference.random import Stream, exponential_of
from clpipe.stage import (
    Arguments,
    Backend,
    Context,
    Kind,
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


class TwoLevels(SignalMethod):
    """y + A / 2 or y - A / 2 in a share of the pixels, at random in each frame.

    A trap in a pixel's transistor catches an electron and releases it, which shifts the pixel's
    level (Wang et al., "Random telegraph signal in CMOS image sensor pixels", IEDM 2006). For a
    camera, the affected pixels and the distance A of their levels are fixed; A has an exponential
    distribution. Some pixels therefore have more read noise than others, and the read noise of the
    sensor has longer tails.

    >>> from clpipe.stage import run_reference
    >>> black = np.zeros((400, 400), np.float32)
    >>> noisy = run_reference(TwoLevels(share=0.05, amplitude=0.1), black)
    >>> round(float((noisy != 0).mean()), 2), round(float(abs(noisy[noisy != 0]).mean()), 3)
    (0.05, 0.05)
    """

    method: ClassVar = "two_levels"
    kernel: ClassVar = "random_telegraph"
    summary: ClassVar = "a share of the pixels jumps between two levels"
    example: ClassVar = {"share": 0.05, "amplitude": 0.05}

    share: float | None = camera_parameter("Share of the pixels that jump.", ge=0, le=0.1)
    amplitude: float | None = camera_parameter(
        "Mean distance between the two levels.", "signal", more=" and ISO", ge=0, le=1
    )

    def resolve(self, context: Context) -> "TwoLevels":
        camera = context.camera
        amplitude = camera.signal_of(camera.rts_amplitude, context.iso)
        return self.with_defaults(share=camera.rts_share, amplitude=amplitude)

    def passes(self) -> tuple[Pass, ...]:
        if not self.share or not self.amplitude:
            return ()
        names = ("limit", "scale", "amplitude")
        return (
            Pass(
                "telegraph_levels",
                arguments=names,
                writes="levels",
                kind=Kind.PAIR,
                random=NoiseScope.CAMERA,
            ),
            Pass("telegraph", reads=("levels",), random=NoiseScope.IMAGE),
        )

    def arguments(self, context: Context) -> Arguments:
        assert self.share is not None
        limit = round(self.share * RANDOM_WORDS)  # the words below it choose a pixel
        return {"limit": limit, "scale": 1 / max(limit, 1), "amplitude": self.amplitude}

    def variance(self, input_variance: Floats, signal: Floats, context: Context) -> Floats:
        """The mean variance over the sensor: share * E[A^2] / 4, E[A^2] = 2 amplitude^2."""
        return input_variance + np.float32(self.share) * np.float32(
            self.amplitude
        ) ** 2 / np.float32(2)

    @classmethod
    def apply(cls, y: Signal, n: Numbers, backend: Backend) -> Signal:
        levels = backend.fixed(levels_of_sensor, lambda method, _: (method.share,))
        step = levels * n["amplitude"] * 0.5
        return backend.where(backend.in_upper_half(backend.words(1)), y + step, y - step)


def levels_of_sensor(height: int, width: int, stream: Stream, share: float) -> Floats:
    """Return the distance of a pixel's two levels over the mean distance, and 0 without levels."""
    bits, limit = sensor_bits(height, width, stream), round(share * RANDOM_WORDS)
    return np.where(bits < limit, exponential_of(bits, limit), np.float32(0))


STAGE = sensor_stage(
    "random_telegraph",
    "Add random telegraph noise: some pixels jump between two levels.",
    (TwoLevels,),
)
