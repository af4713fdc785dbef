"""High dynamic range in one exposure: it is read several times, and the readouts are merged."""

from dataclasses import replace
from typing import ClassVar, Self

import numpy as np
from pydantic import PrivateAttr

from clpipe.base.errors import RequestError
from clpipe.base.types import Floats
from clpipe.reference.math import square_root
from clpipe.reference.random import normal_at
from clpipe.stage import (
    Arguments,
    CompileTime,
    Context,
    Method,
    NoiseScope,
    Pass,
    ReferenceContext,
    parameter,
)
from clpipe.stages.sensor_noise.common import NEVER_FULL, or_default
from clpipe.stages.sensor_noise.model import SensorNoise
from clpipe.stages.sensor_noise.no_noise import NoNoise

RATIO = 16.0  # of a sensor that does not say its own
ENDS, STEEP = np.float32(0.95), np.float32(10.0)  # of a hand-over, which begins at 0.85


class Readouts(SensorNoise):
    """Several readouts of an exposure, each with noise, rounding and a white level of its own.

    The first one is the camera's at its ISO: a and b are its. Each further one is less sensitive by
    ``ratio``, so the last one has its white at a signal of ``ratio ** (count - 1)``, which
    ``quantize`` takes for the white level; behind ``normalize`` 1 is the first one's white, and
    what is brighter is above 1. The merged signal is that of the first readout that is
    below 0.85 of its white; from there to 0.95 it goes over linearly to the next one. There the
    signal-to-noise ratio dips, since the next one has collected or amplified less.
    """

    kernel: ClassVar = "sensor_noise_readouts"
    shares_charge: ClassVar[bool] = False

    ratio: float | None = parameter(
        None,
        "How much less sensitive each readout is than the one before.",
        auto="from the camera; else 16",
        gt=1,
        le=1024,
    )
    later_noise: float | None = parameter(
        None,
        "Read noise of the further readouts over that of the first, both in DN.",
        auto="from the camera; else 1",
        ge=0,
        le=1000,
    )
    part: int | None = parameter(
        None,
        "The number of the readout that is looked at alone, from 0 on.",
        auto="merged",
        structural=True,
        ge=0,
        le=3,
    )

    _range: float = PrivateAttr(1.0)  # of the camera, DN

    @property
    def readouts(self) -> int:
        """How many readouts there are."""
        return 2

    @property
    def full_scale(self) -> float:
        """The signal at which the last readout is white."""
        assert self.ratio is not None
        return float(self.ratio ** (self.readouts - 1))

    def resolve(self, context: Context) -> Self:
        if self.part is not None and self.part >= self.readouts:
            raise RequestError(
                f"sensor_noise.part: found {self.part}; there are 0 to {self.readouts - 1}"
            )
        camera = context.camera
        own = super().resolve(context)
        own = own.with_defaults(ratio=camera.readout_ratio, later_noise=camera.readout_noise)
        own = own.with_defaults(ratio=RATIO, later_noise=1.0)
        own._range = camera.signal_range
        return own

    def next_context(self, context: Context) -> Context:
        return replace(super().next_context(context), full_scale=self.full_scale)

    def passes(self) -> tuple[Pass, ...]:
        numbers = ("a", "b", "later_b", "full_well", "down", "up", "range", "unit")
        names = ("count", "shared", "part", *numbers)
        return (Pass("readouts", arguments=names, random=NoiseScope.IMAGE),)

    def without_noise(self) -> Method | None:
        return NoNoise(full_signal=self.full_scale)

    def numbers(self) -> dict[str, np.float32]:
        assert self.b is not None and self.ratio is not None and self.later_noise is not None
        return {
            "a": np.float32(self.a),
            "b": np.float32(self.b),
            "later_b": np.float32(self.b * self.later_noise**2),
            "full_well": np.float32(or_default(self.full_signal, NEVER_FULL)),
            "down": np.float32(1 / self.ratio),
            "up": np.float32(self.ratio),
            "range": np.float32(self._range),
            "unit": np.float32(1 / self._range),
        }

    def arguments(self, context: Context) -> Arguments:
        structure = {
            "count": self.readouts,
            "shared": int(self.shares_charge),
            "part": -1 if self.part is None else self.part,
        }
        return {**self.numbers(), **{k: CompileTime(str(v)) for k, v in structure.items()}}

    def own_variance(self, signal: Floats) -> Floats:
        n = self.numbers()
        one = np.float32(1)
        shared = n["a"] * signal if self.shares_charge else np.zeros_like(signal)
        merged = np.zeros_like(signal)
        for i in reversed(range(self.readouts)):
            down = n["down"] ** i
            shot = np.zeros_like(signal) if self.shares_charge else n["a"] * signal / down
            own = shot + (n["later_b"] if i else n["b"]) / down**2
            if self.part is not None:
                merged = own if i == self.part else merged
            elif i == self.readouts - 1:
                merged = own
            else:
                weight = self._weight(signal * down)
                merged = weight**2 * own + (one - weight) ** 2 * merged
        return np.asarray(merged + shared, np.float32)

    @staticmethod
    def _weight(read: Floats) -> Floats:
        """How much of the merged signal is a readout's, by what it says."""
        return np.minimum(np.maximum((ENDS - read) * STEEP, np.float32(0)), np.float32(1))

    def reference(self, image: Floats, given: ReferenceContext) -> Floats:
        n, stream = self.numbers(), given.stream[NoiseScope.IMAGE]
        charge, first = image, int(self.shares_charge)
        if self.shares_charge:
            shot = square_root(np.maximum(n["a"] * image, np.float32(0)))
            charge = np.minimum(image + normal_at(image.shape, 0, stream) * shot, n["full_well"])
        sensitivity = inverse = np.float32(1)
        values, weights = [], []
        for i in range(self.readouts):
            own_b = n["later_b"] if i else n["b"]
            light = charge * sensitivity
            variance = (
                np.full_like(light, own_b)
                if self.shares_charge
                else np.maximum(n["a"] * light + own_b, np.float32(0))
            )
            noisy = light + normal_at(image.shape, i + first, stream) * square_root(variance)
            read = np.minimum(np.rint(noisy * n["range"]) * n["unit"], np.float32(1))
            values.append(read * inverse)
            weights.append(self._weight(read))
            sensitivity, inverse = sensitivity * n["down"], inverse * n["up"]
        if self.part is not None:
            return values[self.part]
        merged = values[-1]
        for value, weight in zip(values[-2::-1], weights[-2::-1], strict=True):
            merged = weight * value + (np.float32(1) - weight) * merged
        return merged


class DualGain(Readouts):
    """Dual conversion gain: one charge is read at a high and at a low gain, ``ratio`` apart.

    Its shot noise is the same in both. LOFIC sensors are like it, with a larger ratio: the second
    reading is that of a capacitor into which a full photodiode overflows.

    >>> from clpipe.stage import run_reference
    >>> noisy = run_reference(DualGain(a=1e-4, b=1e-6), np.full((200, 200), 8.0, np.float32))
    >>> round(float(noisy.mean()), 1), round(float(noisy.var()), 4)
    (8.0, 0.0011)
    """

    method: ClassVar = "dual_gain"
    summary: ClassVar = "one charge read at two gains, and merged"
    other_examples: ClassVar = ({"part": 1},)
    shares_charge: ClassVar = True


class SplitPixel(Readouts):
    """Split pixels: a large and a small photodiode, of which the small one sees 1/``ratio``."""

    method: ClassVar = "split_pixel"
    summary: ClassVar = "a large and a small photodiode in each pixel, merged"


class Staggered(Readouts):
    """Staggered exposures (DOL): 2 to 4 in a row, each ``ratio`` times shorter than the one before.

    All see the same scene: motion between them is not modelled.
    """

    method: ClassVar = "staggered"
    summary: ClassVar = "two to four exposures, each shorter than the one before, merged"
    other_examples: ClassVar = ({"count": 4},)

    count: int = parameter(3, "How many exposures there are.", structural=True, ge=2, le=4)

    @property
    def readouts(self) -> int:
        return self.count
